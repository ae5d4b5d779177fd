"""The commands of the console program, one small file each: a dataclass of options with ``run()``.

The dataclasses are read to print the help, so that these files import nothing slow at their top; Taichi
and what needs it are imported when a command runs.
"""
