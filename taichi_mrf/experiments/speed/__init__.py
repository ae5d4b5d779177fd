"""Measurements of speed: the benchmark, the profiler, floors given by memory bandwidth."""
