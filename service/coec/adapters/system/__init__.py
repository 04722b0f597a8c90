"""The operating system: logs, threads, memory, the service manager."""
