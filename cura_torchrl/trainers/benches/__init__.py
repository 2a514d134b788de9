"""How fast each part is, as ratios of one run."""
