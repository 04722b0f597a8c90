"""What judges windows beside each other: a pool of processes here, or an engine that is there."""
