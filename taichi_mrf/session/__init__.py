"""A live run: frames when they are due, requests of the page, what has changed.

Uses `mapping`, `evaluation` and `viewer`.
"""
