"""What the service says when it is asked."""
