"""Tuning parameters: trials, their scores, the search.

Uses `mapping`, `evaluation` and `viewer`.
"""
