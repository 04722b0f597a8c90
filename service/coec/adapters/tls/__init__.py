"""TLS without a socket: who gives a command proves it inside queries."""
