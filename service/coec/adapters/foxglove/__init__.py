"""The live view: pictures and a timeline for viewers that speak `foxglove.sdk.v1` (Foxglove, Lichtblick).

`shown` makes the pictures, `timeline` the lines of the timeline; only `server` needs the optional extra `foxglove`.
"""
