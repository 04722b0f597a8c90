"""How far a window is believed against what it was told.

Two answers are weighed as Bayes weighs them: what was told is right, as well as it is known; or it is wrong, and the
window is all there is. What the window adds to the error of its pose is what the pose moves by in each case, root mean
square. Nothing about it jumps: a gain that is a little surer counts a little more.
"""

from __future__ import annotations

from math import sqrt, tanh

CENTRE_EVEN = 1.5
"""Certainty (`landscape.certainty`) at which a centre is as likely wrong as right: three standard deviations. Standing
in rooms and garages a window sees a right one 3 to 5 cm beside by two of them, at certainties of 1."""

LEAST_CERTAINTY = 1e-6
"""What is less certain places a centre of decimetres beyond kilometres: nowhere."""

LEAST_M2 = 1e-12
"""A centre is never known, nor measured, to better than a thousandth of a millimetre."""


def in_centre(certainty: float, off_m: float, known_m: float) -> float:
    """By what share the shift counts that a window sees its camera's centre off by: 0 of none, 1 of one that is beyond
    doubt.

    Where the centre is as well known as it was told, the measured place and the told one are weighed by their variances
    (Wiener 1949): a window that tells the centre to 3 cm says little of one that is known to 1 cm.

    Args:
        certainty: of what the window gains by it; see `Landscape.certainty`: half the distance in standard deviations.
        off_m: by how much.
        known_m: standard deviation of the place that was told, along each axis.
    """
    if certainty <= LEAST_CERTAINTY or off_m <= 0.0:
        return 0.0
    measured = (off_m / (2.0 * certainty)) ** 2
    if_right = 1.0 - measured / max(known_m * known_m + measured, LEAST_M2)
    is_wrong = in_doubt(certainty, CENTRE_EVEN) ** 2
    return sqrt((1.0 - is_wrong) * if_right * if_right + is_wrong)


def in_doubt(certainty: float, even: float) -> float:
    """By what share the shift counts of something that is either right or not: the root of the probability that it is
    not. A gain of certainty c makes it 4·c² nats likelier: the square of the distance in standard deviations by half,
    (2·c)²/2, and twice that as those are √2 too wide (see `Landscape.certainty` and `scatter`). Three unknowns more
    fit as much better by chance at `even`; what is lost by them speaks for what was told."""
    return sqrt(_probability(4.0 * (certainty * abs(certainty) - even * even)))


def _probability(nats: float) -> float:
    """Of odds, that are given by their logarithm."""
    return 0.5 * (1.0 + tanh(0.5 * nats))
