"""Experiments on stereo depth, in the manner of Schauwecker and Zell's section IV."""
