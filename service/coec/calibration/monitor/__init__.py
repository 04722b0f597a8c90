"""Is what is served still right? One check, its verdict, the change detector, sensor faults."""
