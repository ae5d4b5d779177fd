"""What all kernels share: argument types, bundles of arguments, launches, arrays, logarithms.

Begin with ``bundles.py``: how a kernel takes five arguments and not forty.

Uses `system`.
"""
