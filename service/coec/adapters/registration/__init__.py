"""Libraries that search in point clouds."""
