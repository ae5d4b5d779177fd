"""Reading a map: points, boxes, slices, rays, distances, frontiers.

Uses `sensor`, `voxels` and the packages below them. Knows no mapping method.
"""
