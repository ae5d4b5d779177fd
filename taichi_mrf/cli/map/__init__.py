"""The command ``taichi-mrf map``."""
