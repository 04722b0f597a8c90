"""Several sensors of one vehicle together: who moved, and where everything is."""
