"""Common parts of both pages: the base page, its panel, and the 3D scene (voxels, cuts, keyframes, rays).

Uses `viewer.transport` and the packages below `viewer`.
"""
