"""Frames as msgpack, and what every frame is asked before it is believed."""
