"""A vehicle that does not exist: a procedural street, cameras and LiDARs cast by rays in it, faults, and the truth.

Needs the optional extra `sim` (embreex: Intel's Embree). World frame: x, y horizontal, z up, metres. Everything follows
from a seed: the same seed gives the same bytes.
"""
