"""How fast: what a keyframe costs, stage by stage, beside OctoMap. The experiments of papers time with it."""
