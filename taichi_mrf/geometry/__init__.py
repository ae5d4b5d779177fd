"""Rigid transforms, and which way is up.

Begin with ``poses.py``: every pose of the program passes its checks.

Uses `system` only.
"""
