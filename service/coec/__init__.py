"""Continuous online extrinsic calibration of a camera and a LiDAR."""

__version__ = "0.1.0"
