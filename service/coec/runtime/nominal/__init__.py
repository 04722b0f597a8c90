"""Nominal calibrations that the configuration leaves out: listens for them on the bus, finds and keeps them."""
