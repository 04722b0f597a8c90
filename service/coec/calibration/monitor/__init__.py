"""Is the served extrinsic still right? One check, its verdict, the change detector, sensor faults."""
