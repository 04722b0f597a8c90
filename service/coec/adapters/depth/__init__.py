"""Depth maps: from networks with model cards, or received with the frames."""
