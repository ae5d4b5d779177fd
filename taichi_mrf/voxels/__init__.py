"""Chunks, bricks and voxels: numbering, the topology, the pool, rays through the grid.

Uses `kernels`, `geometry` and `system`.
"""
