"""Puts together what the pairs of one vehicle report, in one order and on one thread."""
