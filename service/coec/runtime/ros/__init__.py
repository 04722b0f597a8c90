"""Output to ROS 2: diagnostics, the calibrated frames, intrinsics, pictures."""
