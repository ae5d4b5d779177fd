"""The console program: it parses the command line, calls the library and prints.

`commands.py` lists the commands, `options/` holds the dataclass of each, and the other modules carry them
out; map, live and tune are composed in `apps/`, of parts that are here. A command's module is imported when
the command runs, so that the help needs neither Taichi nor NumPy.
"""
