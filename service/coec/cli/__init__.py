"""The command line: one module a command, and the frame of all, `main`."""
