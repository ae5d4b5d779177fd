"""Chunks, bricks and voxels: numbering, the topology, the pool, rays through the grid.

Begin with ``layout.py``, the three levels of space, then ``topology.py`` (which bricks there are),
``pool.py`` (where their voxels lie) and ``traversal.py`` (rays through them). ``layers.py`` lists what a map
keeps for each voxel.

Uses `kernels`, `geometry` and `system`.
"""
