"""How much processor time the pairs of a daemon may spend together, and whose turn it is."""
