"""MAP inference on explicit factor graphs, whose factors are whole beams (Dhiman et al., ICRA 2014).

Begin with ``graph.py`` (the graph of section III-C) and ``solve.py`` (one call for every method). Each method
of inference is a file: ``metropolis_hastings.py``, ``belief_propagation.py``, ``dual_decomposition.py``.
"""
