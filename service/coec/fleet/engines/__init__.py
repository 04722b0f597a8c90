"""Engines that judge windows in parallel: a pool of processes on this machine, or an existing cluster."""
