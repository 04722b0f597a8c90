"""Range jumps and image edges, and how well they lie on each other."""
