"""Maps larger than one machine: the plane is cut into submaps, each is inferred as a task of its own, and
what they believe at their borders is exchanged in rounds.

Begin with ``rounds.py``, which goes through survey, plan, rounds and merge. docs/submaps.md tells how well
that works.
"""
