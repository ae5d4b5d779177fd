"""Occupancy mapping by independent log-odds, OctoMap's method."""
