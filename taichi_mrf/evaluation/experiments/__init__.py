"""The papers' tables and figures, each from one call: scenes, contenders, scores, tables and pictures.

The laboratory uses the library as any user does: maps, sensors and queries by their public names, and the
packages that judge, draw and cut into submaps. `taichi-mrf eval` finds it by name; nothing else imports it.
"""
