"""The command ``taichi-mrf laser``."""
