"""How fast a map is made: the cost of a keyframe stage by stage, beside OctoMap's.

Begin with ``keyframe_cost.py``, which says what is timed. ``bench.py`` maps a recording and fills the table
of ``taichi-mrf bench``; `experiments` times its rivals in the same way.
"""
