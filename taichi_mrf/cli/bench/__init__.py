"""The command ``taichi-mrf bench``."""
