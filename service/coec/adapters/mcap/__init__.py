"""MCAP files: windows, bags, what both have in common."""
