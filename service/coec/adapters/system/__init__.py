"""The operating system: logs, threads, memory, service manager."""
