"""A live run: frames when they are due, requests of the page, and what has changed since.

Begin with ``session.py``, the loop, and ``run.py``, its state. ``mapper.py`` is the map with its keyframes,
``requests.py`` answers the page, ``own_loop.py`` is ``tm.live`` in one's own loop.

Uses `mapping`, `evaluation` and `viewer`.
"""
