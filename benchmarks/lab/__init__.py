"""Measurements beyond the papers' tables: `python -m benchmarks.lab NAME`, from the root of the project."""
