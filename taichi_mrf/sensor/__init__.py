"""The sensor: cameras, noise, the likelihood of a measurement, simulated noise.

Begin with ``camera.py`` and ``noise.py``, what a user passes in, and ``model.py``, the sensor as kernels see
it and how a camera or a noise model of one's own plugs in. ``forward.py`` is nu of eq. 4.

Uses `voxels` and the packages below it.
"""
