"""Diagnosis of recordings whose frames contradict each other because of a usual mistake of conventions.

Begin with ``diagnosis.py``: ``taichi-mrf doctor`` prints what its ``diagnose`` finds, and ``map`` refuses a
recording by it. ``readings.py`` lists the mistakes, ``search.py`` tries them on pairs of frames.
"""
