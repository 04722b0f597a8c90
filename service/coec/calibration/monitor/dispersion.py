"""How much farther the checks of a scene scatter than those of a street.

Other things in the image displace an optimum, and the less, the higher it stands above them: the top of a hill on rough
ground is where hill and roughness together are highest. Every check measures how high its optimum stands (`contrast`).
So a highway, where everything runs to one point, or a night accuses a mount no more than it can tell, without a step
between scenes that tell and scenes that do not.

This factor says what checks are worth as evidence. Whether a check is flagged depends on the limits of its rig and on
its own edges, see `support`; in scenes that scatter too far no check is flagged.
"""

from __future__ import annotations

REFERENCE_CONTRAST, POWER = 20.0, 1.5
"""Contrast from which checks scatter as those of a street do, and the power of its inverse by which others scatter
more. Learned on 212 checks of right mounts on 74 simulated drives (streets, rain, low sun, garages, rooms, highways,
nights, tunnels, open roads; five lenses of 56 to 190°, 32 and 64 beams). Offsets at a contrast of 4 to 6, 6 to 8, 8 to
10, 10 to 13, 13 to 17, 17 to 25 and more are 2.6, 2.4, 2.0, 1.0, 0.7, 0.4 and 0.4 standard deviations of a street
(rms), and with this factor 0.3, 0.4, 0.6, 0.4, 0.5, 0.4 and 0.4. The error that checks of a drive share grows as their
own errors do. Given the contrast, the number of independent looks tells nothing more, and the number of range edges
little."""


def dispersion(contrast: float) -> float:
    """Factor from the standard deviations of a street's checks to those of a check with this contrast; at least 1."""
    return float(max(REFERENCE_CONTRAST / max(contrast, 1.0), 1.0) ** POWER)
