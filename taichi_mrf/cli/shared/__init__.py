"""Common parts of several commands: signals, the folder of a run, tables, progress."""
