"""Interface to the machine: Taichi's runtime, devices, memory, launches, files, optional libraries.

Begin with ``runtime.py``, which starts Taichi on the best backend, and ``compiler.py``, which names all that
is used of its internals. ``atomic.py`` writes files whole or not at all; ``files.py``, ``packed.py`` and
``npz_file.py`` read them without trust. ``bundles.py`` is how a kernel takes five arguments and not forty.

Uses no other package of the program; every package may use it.
"""
