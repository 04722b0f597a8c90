"""The Zenoh session: a bus for the service, a client for tools, a player for recordings."""
