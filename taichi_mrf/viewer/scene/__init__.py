"""What both pages share: the base page, its panel, and what is drawn in 3D (voxels, cuts, keyframes, rays).

Uses `viewer.transport` and the packages below `viewer`.
"""
