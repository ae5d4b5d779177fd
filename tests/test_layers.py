"""The table of floors in taichi_mrf/floors.py: a file imports only from rooms that its own room may use."""
