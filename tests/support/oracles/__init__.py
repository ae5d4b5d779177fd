"""What the engine is checked against: small NumPy versions in float64, written for reading, not for speed."""
