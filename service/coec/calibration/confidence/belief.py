"""How far a window is believed if it contradicts its assumptions: the held centre, the clocks, the lens.

Two cases are weighed by Bayes' rule: the assumption is right, within its known accuracy; or it is wrong, and the window
is the only evidence. The error that this adds to the pose is the root mean square of how far the pose moves in each
case. Nothing jumps: a slightly surer gain counts slightly more.
"""

from __future__ import annotations

from math import sqrt, tanh

CENTRE_EVEN = 1.5
"""Certainty (`landscape.certainty`) at which a centre is as likely wrong as right: three standard deviations. Windows
of a standing vehicle in rooms and garages put a right centre 3 to 5 cm aside, by two standard deviations, which is a
certainty of 1."""

LEAST_CERTAINTY = 1e-6
"""Below this certainty a centre that is decimetres off would be known only to kilometres, so it counts as
unmeasured."""

LEAST_M2 = 1e-12
"""Least variance, m²: a centre is neither known nor measured to better than a thousandth of a millimetre."""


def centre_weight(certainty: float, off_m: float, known_m: float) -> float:
    """The share by which a shift of the camera's centre counts that a window sees: 0 for no shift, 1 for one beyond
    doubt.

    In the case that the centre is as well known as assumed, the measured and the assumed place are weighed by their
    variances (Wiener 1949): a window that determines the centre to 3 cm says little of one that is known to 1 cm.

    Args:
        certainty: of the window's gain by the shift, half the distance in standard deviations; see
            `Landscape.certainty`.
        off_m: length of the shift.
        known_m: standard deviation of the assumed place, along each axis.
    """
    if certainty <= LEAST_CERTAINTY or off_m <= 0.0:
        return 0.0
    measured = (off_m / (2.0 * certainty)) ** 2
    if_right = 1.0 - measured / max(known_m * known_m + measured, LEAST_M2)
    is_wrong = posterior_weight(certainty, CENTRE_EVEN) ** 2
    return sqrt((1.0 - is_wrong) * if_right * if_right + is_wrong)


def posterior_weight(certainty: float, even: float) -> float:
    """The share by which the shift counts for an assumption that is either right or wrong: the root of the probability
    that it is wrong.

    A gain of certainty c makes wrong 4·c² nats likelier: half the square of the distance in standard deviations,
    (2·c)²/2, and twice that because those are √2 too wide (see `Landscape.certainty` and `scatter`). At the certainty
    `even` wrong and right are equally likely, because three more unknowns fit that much better by chance. A loss
    (negative certainty) speaks for the assumption.
    """
    return sqrt(_probability(4.0 * (certainty * abs(certainty) - even * even)))


def _probability(nats: float) -> float:
    """The probability for odds given by their logarithm."""
    return 0.5 * (1.0 + tanh(0.5 * nats))
