"""The pose of one LiDAR in another, from surfaces that both see: an edge of a rig without a camera."""
