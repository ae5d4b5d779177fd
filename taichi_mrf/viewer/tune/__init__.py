"""The tuning page.

Uses `viewer.scene` and `viewer.transport`.
"""
