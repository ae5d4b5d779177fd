"""Reading a map: points, boxes, slices, rays, distances, free space, frontiers.

Begin with ``voxel_map.py``, the interface of a map that is read, and ``points.py``, the rule for what is
occupied.

Uses `sensor`, `voxels` and the packages below them. Knows no mapping method.
"""
