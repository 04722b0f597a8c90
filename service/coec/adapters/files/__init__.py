"""Files that are kept, and values as JSON documents."""
