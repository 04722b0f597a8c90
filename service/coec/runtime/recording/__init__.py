"""Windows on the disk: written, kept, removed."""
