"""Common parts of Taichi kernels: argument types, arrays, strips of voxels, logarithms.

Uses `system`.
"""
