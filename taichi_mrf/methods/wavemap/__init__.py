"""Occupancy mapping by wavemap's measurement model (Reijgwart et al., RSS 2023)."""
