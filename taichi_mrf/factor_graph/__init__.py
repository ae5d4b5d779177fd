"""MAP inference on explicit factor graphs, whose factors are whole beams (Dhiman et al., ICRA 2014)."""
