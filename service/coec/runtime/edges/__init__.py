"""Measures the poses of a vehicle's LiDARs against each other: looks at every two of them, from sweeps to the report to
the rig."""
