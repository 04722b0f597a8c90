"""Experiments on the estimator: starts, statistics, split halves, detection, profiles, and the paper's own."""
