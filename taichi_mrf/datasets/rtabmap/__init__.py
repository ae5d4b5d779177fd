"""Databases of RTAB-Map: recordings, and poses that change while it runs."""
