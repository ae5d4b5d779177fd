"""A run: its folder of files; live, also frames when they are due, requests of the page, what has changed.

Begin with ``folder.py``, which writes the same files for `map` and `live`. A live run begins with
``session.py``, the loop, and ``run.py``, its state. ``mapper.py`` is the map with its keyframes,
``requests.py`` answers the page, ``own_loop.py`` is ``tm.live`` in one's own loop.

Uses `mapping`, `evaluation` and `viewer`.
"""
