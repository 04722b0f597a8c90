"""Continuous online extrinsic calibration of a camera and a LiDAR."""

import os

__version__ = "0.1.0"

# onnxruntime reports to its vendor over the internet unless it is told not to before it is imported. A vehicle's
# service speaks to nobody it was not told to.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
