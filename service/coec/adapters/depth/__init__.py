"""Depth maps: networks with their cards, and maps that came with the frames."""
