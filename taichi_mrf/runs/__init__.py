"""The folder of a mapping run: map, voxels, parameters, report, pictures. `map` and `live` write the same
files.

Uses `mapping`, `evaluation` and `export`.
"""
