"""A simulated vehicle: a procedural street, cameras and LiDARs rendered in it by ray casting, faults, and the truth.

Rays are cast by embreex (Intel's Embree). World frame: x, y horizontal, z up, metres. Everything follows
from a seed: the same seed gives the same bytes.
"""
