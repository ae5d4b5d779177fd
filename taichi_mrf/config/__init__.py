"""Every parameter of the program, defined once as typed dataclasses, with YAML and help text made from them.

Uses `system`, and needs no Taichi.
"""
