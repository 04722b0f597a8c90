"""What answers change, in order, and where it is written down."""
