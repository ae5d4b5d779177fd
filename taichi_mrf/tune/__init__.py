"""Tuning parameters: trials on held-out frames, their scores, the search.

Begin with ``trial.py``: parameters in, a map and its scores out. ``session.py`` talks to the page.

Uses `mapping`, `evaluation` and `viewer`.
"""
