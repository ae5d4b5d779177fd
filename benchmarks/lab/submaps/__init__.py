"""Experiments on maps larger than one machine."""
