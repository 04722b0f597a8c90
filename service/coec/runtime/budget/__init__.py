"""What the pairs of a daemon may spend of the processor between them, and whose turn it is."""
