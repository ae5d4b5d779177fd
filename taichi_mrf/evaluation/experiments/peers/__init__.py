"""Every peer on the same frames: what a frame costs, and what the map is worth."""
