"""Every parameter of the program, defined once as typed dataclasses, with YAML and help text made from them.

Begin with ``schema.py`` and ``sections.py``: a field, its default, its help. ``plugs.py`` lists the mapping
methods, ``gone.py`` the parameters of earlier versions.

Uses `system`, and needs no Taichi.
"""
