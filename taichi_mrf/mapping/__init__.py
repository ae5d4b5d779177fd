"""From frames to a map: which frames become keyframes, adding them, poses, inference.

Uses `methods`, `datasets` and the packages below them.
"""
