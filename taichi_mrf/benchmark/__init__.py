"""How fast: what a keyframe costs, stage by stage and kernel by kernel, beside OctoMap and memory bandwidth.

It measures the computation from inside, so it may use every package that computes. The papers' experiments
take their timings from here.
"""
