"""Learning a sensor's bias and noise from depth whose true value is known, and its sigma from a recording.

Uses `evaluation`, `mapping` and the packages below them.
"""
