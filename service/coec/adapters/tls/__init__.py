"""TLS without a socket: the sender of a command proves its name inside queries."""
