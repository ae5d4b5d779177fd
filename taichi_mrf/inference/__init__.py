"""Message passing between rays and voxels; start with sum_product.py, which reads like the paper.

Uses `sensor`, `voxels` and the packages below them.
"""
