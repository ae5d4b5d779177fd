"""MRFMap (Shankar and Michael, RSS 2020): the map object, its bricks, its keyframes and its files."""
