"""Maps as files and messages for other programs.

Begin with ``formats.py``, the one list of formats: a new one is a file and an entry there. ``chunk_store.py``
is the map on disk, ``map_sink.py`` the messages that files and robots' wires share.

Uses `queries` and the packages below it. Knows no mapping method.
"""
