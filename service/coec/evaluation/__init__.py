"""Experiments on the estimator: starts, statistics, split halves, detection, profiles, those of the paper."""
