"""From frames to a map: which frames become keyframes, adding them, poses, inference.

The types of a keyframe and the three numberings are listed in docs/architecture.md.

Uses `methods`, `datasets` and the packages below them.
"""
