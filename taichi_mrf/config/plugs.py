"""The mapping methods that there are. To add one, add its folder and a line here, and
where it has parameters of its own a field to ``Config`` (schema.py).

A plug is a module with a ``METHOD`` (method.py). It stands above this package, so it is named here and
imported by name. It must not import Taichi: every ``taichi-mrf --help`` loads it. A program that brings a
method of its own appends to PLUGS before it imports anything else of taichi_mrf.
"""

PLUGS = [
    "taichi_mrf.methods.mrf.plug",
    "taichi_mrf.methods.log_odds.plug",
    "taichi_mrf.methods.visibility.plug",
    "taichi_mrf.methods.wavemap.plug",
]
"""In the order of YAML and help texts. The first is the default."""
