"""Mapping methods: MRFMap and its baselines, what they have in common, and the registry that lists them.

Uses `inference`, `alignment`, `queries`, `export` and the packages below them.
"""
