"""Rendered sequences: the built-in room and corridor, and triangle meshes."""
