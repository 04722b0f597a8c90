"""Rows of a sweep whose beams are not numbered. Without a kernel: whoever records sweeps thins them by rows, too."""

import math

BAND_RAD = math.radians(0.42)
"""Height of a band of elevation where no ring is known: the beam spacing of a 64-beam sensor. Wider bands only cost
time, narrower ones cut scan lines of a tilted sensor into pieces."""
