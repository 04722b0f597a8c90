"""Nominal calibrations that the configuration leaves out: what is heard of them, found, and kept."""
