"""What is drawn in 3D: voxels, cuts, keyframes, rays.

Uses `viewer.transport` and the packages below `viewer`.
"""
