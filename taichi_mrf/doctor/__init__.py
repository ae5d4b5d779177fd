"""Which usual mistake of conventions makes the frames of a recording contradict each other.

``taichi-mrf doctor`` prints what :func:`~taichi_mrf.doctor.diagnosis.diagnose` finds.
"""
