"""Visibility-aware occupancy mapping (Schauwecker and Zell, IROS 2014)."""
