"""2D laser scans and the floor plans that they are judged by."""
