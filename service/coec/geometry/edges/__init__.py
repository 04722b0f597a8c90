"""Range edges and image edges, and how well they align."""
