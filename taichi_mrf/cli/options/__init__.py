"""The options of each command, as dataclasses from which flags and help are made.

Importing them is quick: neither they nor what they import needs Taichi or NumPy.
"""
