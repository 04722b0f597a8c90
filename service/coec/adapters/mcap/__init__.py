"""MCAP files: windows, bags, and what both have in common."""
