"""What `taichi-mrf bench` does."""
