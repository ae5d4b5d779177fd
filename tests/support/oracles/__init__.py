"""Oracles of the engine: small NumPy versions in float64, written for reading, not for speed."""
