"""The sensor: cameras, noise, the likelihood of a measurement, simulated noise.

Uses `voxels` and the packages below it.
"""
