"""Mapping methods: MRFMap and its baselines, what they share, and how a map is created or loaded by method.

Begin with ``protocol.py``, the interface of all maps, and ``mrf/map.py``, which is ``tm.MRFMap``. Each method
has a folder with its entry (``plug.py``), which ``config/plugs.py`` names.

Uses `inference`, `alignment`, `queries`, `export` and the packages below them.
"""
