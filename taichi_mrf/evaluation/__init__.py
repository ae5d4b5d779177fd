"""Evaluation of a map on data that it has not seen: accuracy, ground truth, reliability, pictures.

Begin with ``accuracy.py``, the paper's measures. ``held_out.py`` checks every run, ``free_space.py`` finds
what levels of free space mean, ``pictures`` draws runs. ``keyframe_cost.py`` times a keyframe stage by stage,
and ``bench.py`` fills the table of ``taichi-mrf bench``.

``experiments`` makes the tables and figures of the papers.

Uses `mapping` and the packages below it.
"""
