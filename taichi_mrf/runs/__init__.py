"""The folder of a mapping run: map, voxels, parameters, report, pictures.

Begin with ``folder.py``: `map` and `live` write the same files with it. ``files.py`` has their names.

Uses `mapping`, `evaluation` and `export`.
"""
