"""Predictions of the collision estimator against what comes of them, and against simulated futures."""
