"""Libraries that search in clouds of points."""
