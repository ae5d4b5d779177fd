"""What `taichi-mrf laser` does."""
