"""Belief propagation between rays and voxels.

Begin with ``sum_product.py``, which reads like the paper: one sweep over one keyframe. ``ray_list.py`` says
which rays a keyframe casts, ``schedule.py`` and ``incremental.py`` who is swept when. A second pass over the
rays (``ray_posterior.py``) serves votes, colours and the measured surface.

Uses `sensor`, `voxels` and the packages below them.
"""
