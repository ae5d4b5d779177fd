"""What Taichi kernels share: argument types, arrays, strips of voxels, logarithms.

Uses `system`.
"""
