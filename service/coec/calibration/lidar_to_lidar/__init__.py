"""Where a LiDAR sits from another one, of what both see: an edge of a rig that no camera has a part in."""
