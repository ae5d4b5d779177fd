"""Interface to the machine: Taichi's runtime, devices, memory, files, optional libraries.

Begin with ``runtime.py``, which starts Taichi on the best backend, and ``compiler.py``, which names all that
is used of its internals. ``atomic.py`` writes files whole or not at all; ``files.py``, ``packed.py`` and
``npz_file.py`` read them without trust.

Uses no other package of the program; every package may use it.
"""
