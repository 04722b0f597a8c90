"""What is kept in files, and values as JSON documents."""
