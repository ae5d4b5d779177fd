"""What `taichi-mrf map` does."""
