"""The web server, the guard between clients and viser, and the pipe to the mapping process.

Uses `viewer.messages` and the packages below `viewer`.
"""
