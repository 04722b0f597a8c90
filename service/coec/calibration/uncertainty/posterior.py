"""The posterior of a window over its pose, lens and clocks, and the hypotheses that compete to explain it.

The log-likelihood of a deviation is κ·z²/2, the profile over the amplitude of the edges of that of independent standard
deviates. Range edges are not independent: neighbours in a sweep, and frames of one view, say the same. κ is the share
of them that is (see `gaussian`), at an optimum that fits, as the variance inflation of a quasi-likelihood is taken from
the most general hypothesis (Burnham, Anderson 2002, section 2.5).

Each hypothesis is a Gaussian prior of the deviation: all as calibrated; the lens a little or grossly off; the clocks
off; the held centre off. Its posterior is the Gaussian next to it, its evidence the integral of that. So a hypothesis
that needs a wide prior has to fit that much better, and a window that does not tell two of them apart leaves both their
prior odds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from math import fsum, inf, log, radians, sqrt
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import Matrix4, Window
from coec.calibration.uncertainty.ascent import Ascent, Vector, ascent, metric
from coec.calibration.uncertainty.displaced_edges import (
    CLOCKS,
    LENS,
    SHIFTS,
    SIZE,
    TURNS,
    AssumedEdges,
    assumed_levels,
    moves,
)
from coec.calibration.uncertainty.gaussian import (
    NEAR,
    PRECISE,
    ROUGH,
    GaussianFit,
    covariance_under,
    deletion_covariance,
    fit_gaussian,
    upper_bound,
)
from coec.geometry import linalg
from coec.geometry.edges.alignment import EdgeFrames

NOMINAL, OTHER_MODE = "nominal", "other_mode"
PRINCIPAL_POINT_OFF, FOCAL_LENGTH_OFF, LENS_OFF = "principal_point_off", "focal_length_off", "lens_off"
CROPPED_ACROSS, CROPPED_DOWN, RESCALED = "cropped_across", "cropped_down", "rescaled"
CLOCKS_OFF, CENTRE_OFF = "clocks_free", "held_free"
"""Names of the hypotheses. They are also names of errors of a pose; see `Posterior.shifts`."""

OF_LENS = (PRINCIPAL_POINT_OFF, FOCAL_LENGTH_OFF, CROPPED_ACROSS, CROPPED_DOWN, RESCALED, LENS_OFF)

ODDS: Mapping[str, float] = MappingProxyType(
    {
        NOMINAL: 0.8,
        OTHER_MODE: 0.8,
        PRINCIPAL_POINT_OFF: 0.05,
        FOCAL_LENGTH_OFF: 0.05,
        CROPPED_ACROSS: 0.04,
        CROPPED_DOWN: 0.04,
        RESCALED: 0.04,
        LENS_OFF: 0.02,
        CLOCKS_OFF: 0.04,
        CENTRE_OFF: 0.04,
    }
)
"""Prior probabilities of the hypotheses, up to a common factor."""

LENS_DRIFT = 0.01
"""Prior of the principal point, in focal lengths, or of the focal length, as a share, of a lens that has changed since
it was calibrated, or was not calibrated with care. Its radial term has half of it."""

LENS_WRONG = (0.05, 0.05, 0.1, 0.02)
"""Prior of intrinsics of another camera, crop or scale."""

CLOCKS_KNOWN, CLOCKS_WRONG = (0.002, 0.001, 0.002), (0.05, 0.02, 0.03)
"""Prior of the clocks, s: as synchronised; and where a stamp is taken at another instant than it says."""

CENTRE_WRONG_M = 0.2

TURN_RAD, SHIFT_M = radians(5.0), 0.5
"""Prior of the pose about its optimum: wide against any σ that is accepted."""

NAMES = MappingProxyType(
    {
        3: "held_across",
        4: "held_down",
        5: "held_forward",
        6: "clock_offset",
        7: "clock_drift",
        8: "readout",
        9: "lens_across",
        10: "lens_down",
        11: "lens_scale",
        12: "lens_radial",
    }
)
"""Names of the errors of a pose by their places in a deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """One explanation of a window.

    Attributes:
        name: see `NOMINAL`.
        probability: of this among all hypotheses.
        deviation: (13,) the most probable one.
        covariance: (13, 13) of the deviation; zero at places that are not free.
    """

    name: str
    probability: float
    deviation: Vector
    covariance: NDArray[np.float64]

    @property
    def lens(self) -> Vector:
        """(4,) the deviation of the lens."""
        return self.deviation[list(LENS)]

    @property
    def lens_sigma(self) -> Vector:
        """(4,) standard deviations of the lens."""
        return np.asarray(np.sqrt(self.covariance.diagonal()[LENS]))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """All hypotheses about a window, the share of its edges that is independent, and the significance of all of them at
    the top of the nominal hypothesis: with lens, clocks and held centre at their most probable."""

    hypotheses: tuple[Hypothesis, ...]
    independent_share: float
    significance: float

    def of(self, *names: str) -> Hypothesis | None:
        """The most probable of the hypotheses of these names; None if none was tried."""
        return max((one for one in self.hypotheses if one.name in names), key=lambda one: one.probability, default=None)

    def probability(self, *names: str) -> float:
        """Of the hypotheses of these names together."""
        return fsum(one.probability for one in self.hypotheses if one.name in names)

    @property
    def better_mode(self) -> Hypothesis | None:
        """Another mode of the nominal hypothesis that is more probable than the one about the given pose."""
        other = self.of(OTHER_MODE)
        return other if other is not None and other.probability > self.hypotheses[0].probability else None

    def noise(self, moved: Sequence[int]) -> NDArray[np.float64]:
        """(n, n) covariance of the pose along n axes of ξ under the nominal hypothesis, with all else known."""
        covariance, axes = self.hypotheses[0].covariance, list(moved)
        others, regression = self._conditional(axes)
        among = covariance[np.ix_(axes, axes)] - linalg.product(covariance[np.ix_(axes, others)], regression)
        return np.asarray(0.5 * (among + among.T))

    def step(self, moved: Sequence[int]) -> Vector:
        """(6,) from the given pose to the mean of the nominal hypothesis, along n axes of ξ, with all else as it was
        assumed."""
        axes, mean = list(moved), self.hypotheses[0].deviation
        others, regression = self._conditional(axes)
        return _at(axes, mean[axes] - np.einsum("mn,m->n", regression, mean[others]))

    def shifts(self, moved: Sequence[int]) -> dict[str, Vector]:
        """By the name of each error, (6,) the shift of the pose along the axes `moved` by one standard deviation.

        The errors of the nominal hypothesis are the columns of a factor of its covariance. Each hypothesis adds how far
        its pose is from that of the nominal one, by the root of its probability: the root mean square of a mixture.
        """
        nominal, axes, best = self.hypotheses[0], list(moved), self.step(moved)[list(moved)]
        others, regression = self._conditional(axes)
        factor = linalg.cholesky(nominal.covariance[np.ix_(others, others)])
        columns = linalg.product(regression.T, factor)
        shifts = {NAMES[place]: _at(axes, column) for place, column in zip(others, columns.T, strict=True)}
        for one in self.hypotheses:
            shifts[one.name] = _at(axes, sqrt(one.probability) * (one.deviation[axes] - best))
        return shifts

    def _conditional(self, axes: list[int]) -> tuple[list[int], NDArray[np.float64]]:
        """The m places of a deviation beside the axes of the pose, and (m, n) how these follow them."""
        covariance = self.hypotheses[0].covariance
        others = [place for place in NAMES if place not in axes and covariance[place, place] > 0.0]
        among = linalg.cholesky(covariance[np.ix_(others, others)])
        return others, linalg.cholesky_solve(among, covariance[np.ix_(others, axes)])


def _at(axes: Sequence[int], values: Vector) -> Vector:
    shift = np.zeros(6)
    shift[list(axes)] = values
    return shift


@dataclass(frozen=True, slots=True, eq=False)
class Assumptions:
    """What is assumed of a window: its edges, and how well lens and held centre are known.

    Attributes:
        edges: of the window, from coarser levels that lead to the sharpest one.
        window: the window.
        held: the translations (places in ξ) that were not searched.
        held_m: the standard deviation to which each of them is known.
        lens_sigma: standard deviations of the principal point, px, and of the focal length, as a share of it.
    """

    edges: Sequence[EdgeFrames]
    window: Window
    held: Sequence[int]
    held_m: float
    lens_sigma: tuple[float, float]

    @property
    def places(self) -> tuple[int, ...]:
        """The places of a deviation that are free."""
        return (*TURNS, *SHIFTS, *(CLOCKS if moves(self.window) else ()), *LENS)

    def levels_at(self, pose: Matrix4) -> list[AssumedEdges]:
        """The levels of the edges, from which deviations are counted at `pose` (4, 4)."""
        return assumed_levels(self.edges, self.window, pose)


def significance_next_to(assumed: Assumptions, pose: Matrix4) -> float:
    """z of the edges at the most probable deviation from `pose` (4, 4) under the nominal hypothesis; infinite if they
    determine none."""
    levels, prior = assumed.levels_at(pose), _priors(assumed)[NOMINAL]
    try:
        led = ascent(levels[-2:], np.zeros(SIZE), (*TURNS, *SHIFTS), prior, GENERAL_SHARE)
        return ascent(levels[-1:], led.deviation, assumed.places, prior, GENERAL_SHARE).significance
    except ValueError:
        return inf


CENTRES_M = (-0.6, -0.4, -0.2, 0.2, 0.4, 0.6)
"""How far along the least certain translation other maxima are climbed. See docs/measured.md."""


SEPARATION = 1.5
"""How far away another maximum is elsewhere, over the largest σ of a translation that is accepted. See
docs/measured.md."""


@dataclass(frozen=True, slots=True)
class OtherCentre:
    """Another maximum of the edges, at another place of the camera's centre.

    Attributes:
        axis: of ξ, along which it lies.
        significance: of the edges there, over that at the result.
    """

    axis: int
    significance: float


def other_centre(
    assumed: Assumptions, levels: Sequence[AssumedEdges], posterior: Posterior, max_sigma_m: float
) -> OtherCentre | None:
    """The most significant other maximum along the translation that is least certain of those that were searched, about
    the nominal hypothesis of the posterior on `levels`; None if there is none.

    Where markings are broken, and where the rings of the LiDAR cross them, edges lie on each other again a stride
    further along the road.
    """
    searched = [place for place in SHIFTS if place not in assumed.held]
    if not searched:
        return None
    nominal, prior = posterior.hypotheses[0], _priors(assumed)[NOMINAL]
    sigma = np.sqrt(nominal.covariance.diagonal())
    along = max(searched, key=lambda place: float(sigma[place]))
    # The pose follows, not lens and clocks: these would undo the shift.
    noise, together = posterior.noise(range(SHIFTS.stop)), np.zeros(SIZE)
    together[: SHIFTS.stop] = noise[:, along] / noise[along, along]

    def top(start: Vector) -> Ascent:
        return ascent(levels[-1:], start, assumed.places, prior, posterior.independent_share)

    try:
        here = top(nominal.deviation)
        others = [top(nominal.deviation + shift_m * together) for shift_m in CENTRES_M]
    except ValueError:  # edges leave the view
        return None
    separation_m = max(SEPARATION * max_sigma_m, SAME_MODE * float(sigma[along]))
    separate = [other.significance for other in others if abs((other.deviation - here.deviation)[along]) > separation_m]
    return OtherCentre(along, max(separate) / max(here.significance, 1.0)) if separate else None


def measure_posterior(assumed: Assumptions, levels: Sequence[AssumedEdges]) -> Posterior | None:
    """The posterior of a window whose search ended at the pose of `levels`; None if its edges determine no pose."""
    places, priors = assumed.places, _priors(assumed)
    try:
        fits = _fits(levels, places, priors)
    except ValueError:
        return None
    evidence = np.array([log(ODDS[name]) + one.log_evidence for name, one in fits])
    weights = np.exp(evidence - evidence.max())
    total = fsum(weights.tolist())
    return Posterior(
        tuple(
            Hypothesis(name, float(weight) / total, one.mean, one.covariance)
            for (name, one), weight in zip(fits, weights, strict=True)
        ),
        fits[0][1].independent_share,
        fits[0][1].significance,
    )


def _priors(assumed: Assumptions) -> dict[str, Vector]:
    """(13,) standard deviations of the deviation, by hypothesis; the first is the nominal one."""
    camera, (pixels, share) = assumed.window.rig.camera, assumed.lens_sigma
    nominal = np.empty(SIZE)
    nominal[TURNS], nominal[SHIFTS] = TURN_RAD, SHIFT_M
    nominal[list(assumed.held)] = max(assumed.held_m, 1e-4)
    nominal[CLOCKS] = CLOCKS_KNOWN
    nominal[LENS] = pixels / camera.fx, pixels / camera.fy, share, 0.5 * share
    others = {
        PRINCIPAL_POINT_OFF: (LENS[:2], (LENS_DRIFT, LENS_DRIFT)),
        FOCAL_LENGTH_OFF: (LENS[2:], (LENS_DRIFT, 0.5 * LENS_DRIFT)),
        CROPPED_ACROSS: (LENS[:1], LENS_WRONG[:1]),
        CROPPED_DOWN: (LENS[1:2], LENS_WRONG[1:2]),
        RESCALED: (LENS[2:3], LENS_WRONG[2:3]),
        LENS_OFF: (LENS, LENS_WRONG),
        **({CLOCKS_OFF: (CLOCKS, CLOCKS_WRONG)} if moves(assumed.window) else {}),
        **({CENTRE_OFF: (SHIFTS, (CENTRE_WRONG_M,) * 3)} if assumed.held else {}),
    }
    priors = {NOMINAL: nominal}
    for name, (places, wide) in others.items():
        priors[name] = nominal.copy()
        priors[name][places] = np.maximum(nominal[places], wide)
    return priors


ZOOMS = (-0.3, -0.18, -0.09, 0.0, 0.09, 0.18, 0.3, 0.42)
OFFSETS = (-0.1, -0.05, 0.0, 0.05, 0.1)
"""Focal lengths, and places of the principal point, at which ascents of the general hypothesis may begin: about as far
apart as the coarsest edges lead."""

ASCENTS = 3
"""How many ascents go on from the coarsest edges to the sharpest, beside that from the lens as assumed. One for each
focal length climbs the coarsest edges."""

GENERAL_SHARE = 0.15
"""The share of independent edges where it is not known yet: it only weighs the priors of the general hypothesis.
See docs/measured.md."""

FARTHEST = 5.0
"""How many standard deviations of its prior a lens may be off. See docs/measured.md."""

AS_GOOD = 6.0
"""Where the log-likelihood of the nominal hypothesis is at most this much below that of the general one, the share of
independent edges is measured at its optimum: that of the general one lies anywhere along its ridges. Six parameters
that are set free gain three by chance."""


def _general_optimum(levels: Sequence[AssumedEdges], places: tuple[int, ...], priors: Mapping[str, Vector]) -> Ascent:
    """The most significant deviation with every parameter free, whatever the lens that was assumed."""
    prior = np.max(list(priors.values()), axis=0)
    turning = (*TURNS, *LENS[:3])
    lenses = [np.array([(*offset, longer) for offset in product(OFFSETS, OFFSETS)]) for longer in ZOOMS]
    begins = _best_with_turns(levels[0], lenses, (1.0,))
    ascended = [ascent(levels[:1], begin, turning, prior, GENERAL_SHARE) for begin in begins]
    ascended = sorted((end for end in ascended if _of_a_lens(end, prior)), key=lambda end: -end.significance)
    leading, begins = (*TURNS, *SHIFTS, *LENS[:3]), [np.zeros(SIZE), *(end.deviation for end in ascended[:ASCENTS])]
    led = [ascent(levels[1:-1], begin, leading, prior, GENERAL_SHARE) for begin in begins]
    settled = [ascent(levels[-1:], end.deviation, leading, prior, GENERAL_SHARE) for end in led]
    settled = [end for end in settled if _of_a_lens(end, prior)]
    if not settled:
        raise ValueError("no lens within reach fits the edges in view")
    best = max(settled, key=lambda end: end.significance)
    general = ascent(levels[-1:], best.deviation, places, prior, GENERAL_SHARE)
    return general if _of_a_lens(general, prior) else best


def _best_with_turns(
    coarse: AssumedEdges, groups: Sequence[NDArray[np.float64]], shares: Sequence[float]
) -> list[Vector]:
    """(13,) for each group of lenses (K, 3), principal point and focal length, the most significant one with one of
    these shares of the turn that makes up for it in the mean of the edges."""
    turning, begins = (*TURNS, *LENS[:3]), []
    edges = coarse.at(np.zeros(SIZE), turning)
    of_edges = metric(edges)
    answer = linalg.product(linalg.inverse(of_edges[:3, :3]), of_edges[:3, 3:])
    for lenses in groups:
        turns, best = -linalg.product(lenses, answer.T), np.zeros(SIZE)
        starts = np.concatenate([np.concatenate([share * turns, lenses], axis=1) for share in shares])
        best[list(turning)] = starts[np.argmax(edges.significances(starts))]
        begins.append(best)
    return begins


MADE_UP = (1.0, 1.25, 1.5)
"""Shares of the turn that makes up for a lens in the mean of the edges. Through a wide lens a pose may have made up for
it in the middle of the image, where a pixel is a larger angle. See docs/measured.md."""

FINE_OFFSETS = (*OFFSETS, -0.075, -0.025, 0.025, 0.075)

ONE_PARAMETER: Mapping[str, tuple[int, tuple[float, ...]]] = MappingProxyType(
    {
        CROPPED_ACROSS: (0, FINE_OFFSETS),
        CROPPED_DOWN: (1, FINE_OFFSETS),
        RESCALED: (2, ZOOMS),
    }
)
"""By the name of a hypothesis with one parameter of the lens: its place, and values at which ascents may begin."""


def _ascent_along(
    levels: Sequence[AssumedEdges], name: str, places: tuple[int, ...], prior: Vector, share: float
) -> Ascent | None:
    """Where an ascent ends from the value of a single parameter of the lens that is the most significant one on the
    coarsest edges; None if that is the value that was assumed, if it leads to no lens, or if the hypothesis has more
    parameters."""
    if name not in ONE_PARAMETER:
        return None
    place, values = ONE_PARAMETER[name]
    (begin,) = _best_with_turns(levels[0], [np.array(values)[:, None] * np.eye(3)[place]], MADE_UP)
    if not begin.any():
        return None
    end = ascent(levels, begin, places, prior, share)
    return end if _of_a_lens(end, prior) else None


def _of_a_lens(end: Ascent, prior: Vector) -> bool:
    """Whether an ascent ended at a lens, rather than where all edges fall onto one pixel."""
    return bool((np.abs(end.deviation[list(LENS)]) <= FARTHEST * prior[list(LENS)]).all())


SAME_MODE = 3.0
"""A maximum within this many standard deviations of another is the same mode."""

ADMISSIBLE = 4.0
"""A hypothesis is also tried about the general optimum, as far as that is within so many standard deviations of its
prior; and another mode has to be, as a whole."""

NEGLIGIBLE = 3e-3
"""A hypothesis that is at most this probable, by an upper bound, is taken at the bound: it adds a twentieth of its
distance to σ."""


def _fits(
    levels: Sequence[AssumedEdges], places: tuple[int, ...], priors: Mapping[str, Vector]
) -> list[tuple[str, GaussianFit]]:
    """The Gaussian of each hypothesis by its name, the nominal one first.

    Raises:
        ValueError: the edges in view determine no pose.
    """
    sharp, of_nominal = levels[-1], priors[NOMINAL]
    general = _general_optimum(levels, places, priors)
    nominal = _nominal(sharp, general, places, priors)
    with_deletion = nominal.covariance + deletion_covariance(sharp, nominal, places, of_nominal)
    fits = [(NOMINAL, replace(nominal, covariance=with_deletion))]
    for name, prior in priors.items():
        if name != NOMINAL:
            fits.append((name, _alternative(levels, name, general, nominal, places, of_nominal, prior)))
    other = _other_mode(levels, general, nominal, np.sqrt(with_deletion.diagonal()), places, of_nominal)
    return fits if other is None else [*fits, (OTHER_MODE, other)]


def _other_mode(
    levels: Sequence[AssumedEdges],
    general: Ascent,
    nominal: GaussianFit,
    sigma: Vector,
    places: tuple[int, ...],
    prior: Vector,
) -> GaussianFit | None:
    """The most probable mode of the nominal hypothesis that is another than that of its Gaussian, of standard
    deviations `sigma` (13,); None if there is none. It is looked for from the given pose, which the Gaussian may have
    left for a lower and wider mode, and from that of the general optimum."""
    share, of_general = nominal.independent_share, np.zeros(SIZE)
    of_general[: SHIFTS.stop] = general.deviation[: SHIFTS.stop]
    least, modes = nominal.log_posterior + log(NEGLIGIBLE), []
    for start, leading in ((np.zeros(SIZE), levels[-1:]), (of_general, levels[-2:])):
        end = ascent(leading, start, places, prior, share)
        contradicted = bool((np.abs(end.deviation) > ADMISSIBLE * prior).any())
        if contradicted or end.log_posterior < least or not _is_away(end.deviation, nominal.mean, sigma):
            continue
        mode = fit_gaussian(levels[-1], end.deviation, places, prior, share, effort=ROUGH, share_is_known=True)
        if _is_away(mode.mean, nominal.mean, sigma):
            # As wide as the nominal mode: edges that fit nothing are wide, and are no mode.
            evidence = nominal.log_evidence + mode.log_posterior - nominal.log_posterior
            modes.append(replace(mode, log_evidence=evidence))
    return max(modes, key=lambda mode: mode.log_evidence, default=None)


def _is_away(deviation: Vector, mean: Vector, sigma: Vector) -> bool:
    """Whether the pose of a deviation (13,) is another mode than that of a mean (13,), of standard deviations (13,)."""
    return float(np.max(np.abs(deviation - mean)[: SHIFTS.stop] / sigma[: SHIFTS.stop])) >= SAME_MODE


def _nominal(
    sharp: AssumedEdges, general: Ascent, places: tuple[int, ...], priors: Mapping[str, Vector]
) -> GaussianFit:
    """The nominal Gaussian, with the share of independent edges at it, or at the general optimum if that fits better.

    Raises:
        ValueError: the edges in view determine no pose.
    """

    def fit(start: Vector, prior: Vector, share: float | None) -> GaussianFit:
        guess, known = GENERAL_SHARE if share is None else share, share is not None
        return fit_gaussian(sharp, start, places, prior, guess, effort=PRECISE, share_is_known=known)

    try:
        nominal = fit(np.zeros(SIZE), priors[NOMINAL], None)
        if 0.5 * GENERAL_SHARE * (general.significance**2 - nominal.significance**2) <= AS_GOOD:
            return nominal
    except ValueError:
        pass
    best = fit(general.deviation, np.max(list(priors.values()), axis=0), None)
    return fit(np.zeros(SIZE), priors[NOMINAL], best.independent_share)


def _alternative(
    levels: Sequence[AssumedEdges],
    name: str,
    general: Ascent,
    nominal: GaussianFit,
    places: tuple[int, ...],
    of_nominal: Vector,
    prior: Vector,
) -> GaussianFit:
    """The Gaussian of another hypothesis than the nominal one, from the highest of three places: the mean of the
    nominal Gaussian; where an ascent from the general optimum ends, as far as that is admissible; and where one ends
    that begins with a single parameter of the lens."""
    share = nominal.independent_share
    admissible = np.abs(general.deviation) <= ADMISSIBLE * prior
    end = ascent(levels[-1:], np.where(admissible, general.deviation, 0.0), places, prior, share)
    along = _ascent_along(levels, name, places, prior, share)
    off = (nominal.mean / prior)[list(places)]
    there = 0.5 * share * nominal.significance**2 - 0.5 * float(np.sum(off * off))
    ends = (end, Ascent(nominal.mean, nominal.significance, there), *(() if along is None else (along,)))
    top = max(ends, key=lambda place: place.log_posterior)
    # A place that is much higher is on another hill, of another width.
    same_hill = top.log_posterior - there <= AS_GOOD
    covariance = covariance_under(nominal, places, of_nominal, prior) if same_hill else None
    if covariance is not None:
        bound = upper_bound(top, share, covariance, places, prior)
        if bound.log_evidence + log(ODDS[name] / ODDS[NOMINAL] / NEGLIGIBLE) < nominal.log_evidence:
            return bound
    effort = ROUGH if covariance is None else NEAR
    return fit_gaussian(
        levels[-1], top.deviation, places, prior, share, effort=effort, share_is_known=True, covariance=covariance
    )


def log_odds(probability: float) -> float:
    """Natural logarithm of the odds of a probability; bounded at 1e-300."""
    return log(max(probability, 1e-300)) - log(max(1.0 - probability, 1e-300))
