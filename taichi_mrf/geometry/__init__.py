"""Rigid transforms.

Uses `system` only.
"""
