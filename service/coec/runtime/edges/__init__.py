"""Where the LiDARs of a vehicle sit to one another: looks at every two of them, from sweeps to what the rig is told."""
