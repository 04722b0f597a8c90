"""`coec.evaluate`, until it is an entry point of another package."""
