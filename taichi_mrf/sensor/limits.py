"""Limits of noise that the host's noise models and the kernels share."""

TERMS = 5
"""Coefficients of a polynomial in the kernels: up to degree 4, padded with zeros."""

LEAST_SIGMA_M = 1e-3
"""Fitted polynomials can fall to zero or below; no depth camera is more precise than this."""
