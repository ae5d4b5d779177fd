"""Learning a sensor's bias and noise from depth whose true value is known.

Uses `evaluation.pictures`, `datasets` and the packages below them.
"""
