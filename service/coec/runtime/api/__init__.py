"""The answers of the service to queries and commands."""
