"""What a person sees live: pictures and a timeline for viewers that speak `foxglove.sdk.v1` (Foxglove, Lichtblick).

`shown` decides what is seen, `timeline` what is told; `server` alone needs the optional extra `foxglove`.
"""
