"""Interface to the machine: Taichi's runtime, devices, memory, files, optional libraries.

Uses no other package of the program; every package may use it.
"""
