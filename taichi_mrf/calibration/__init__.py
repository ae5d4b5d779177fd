"""A sensor's bias and noise, learnt from depth whose true value is known, or from a recording alone.

Begin with ``fit.py``: pairs of measured and true depth (``pairs.py``) in, a noise model out.
``truth_sources.py`` has the three kinds of truth, ``from_recording.py`` learns sigma from the recording that
is mapped.

Uses `evaluation`, `mapping` and the packages below them.
"""
