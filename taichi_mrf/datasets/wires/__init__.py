"""Robots that run, as sources of topics: the protocols by which they send them."""
