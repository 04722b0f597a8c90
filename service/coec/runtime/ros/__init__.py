"""What ROS 2 nodes are told: diagnostics, the calibrated frames, intrinsics, pictures."""
