"""Scores of 2D floor maps against a floor plan."""
