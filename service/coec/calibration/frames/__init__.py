"""From frames to a window: pairing, motion compensation, sampling, ego mask, timing."""
