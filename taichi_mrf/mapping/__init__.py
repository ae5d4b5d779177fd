"""From frames to a map: which frames become keyframes, adding them, poses, inference.

Begin with ``pipeline.py`` (a whole recording) and ``intake.py`` (one frame), which live runs use too.
``tracking.py`` finds poses where none are recorded, ``onto.py`` continues yesterday's map. The types of a
keyframe and the three numberings are listed in docs/architecture.md.

Uses `methods`, `datasets` and the packages below them.
"""
