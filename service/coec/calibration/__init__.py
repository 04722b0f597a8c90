"""The flow from frames to a decision. Plain objects: no socket, file, thread or clock."""
