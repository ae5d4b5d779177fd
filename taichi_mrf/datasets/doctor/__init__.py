"""Which usual mistake of conventions makes the frames of a recording contradict each other.

Begin with ``diagnosis.py``: ``taichi-mrf doctor`` prints what its ``diagnose`` finds, and ``map`` refuses a
recording by it. ``readings.py`` lists the mistakes, ``search.py`` tries them on pairs of frames.
"""
