"""What several commands need: signals, the folder of a run, tables, progress."""
