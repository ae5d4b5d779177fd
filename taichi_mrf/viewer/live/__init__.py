"""The live page.

Uses `viewer.scene` and `viewer.transport`.
"""
