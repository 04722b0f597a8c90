"""Clocks of a recording's streams, as their stamps show them, and the times at which a recorder received them."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray


def clocks_text(camera_stamps_ns: Sequence[int], sweep_stamps_ns: Sequence[int]) -> str:
    """How far the stamps of two streams are apart if no frame of one has a partner in the other, and what to do."""
    if not camera_stamps_ns or not sweep_stamps_ns:
        return "one of the two streams is empty"
    cameras, sweeps = (np.array(stamps, dtype=np.float64) * 1e-9 for stamps in (camera_stamps_ns, sweep_stamps_ns))
    offset_s = float(np.median([sweeps[np.abs(sweeps - stamp_s).argmin()] - stamp_s for stamp_s in cameras]))
    overlap = sweeps[0] <= cameras[-1] and cameras[0] <= sweeps[-1]
    if not overlap:
        offset_s = float(sweeps[0] - cameras[0])
    return _offset_text(_known_gap_s(cameras, sweeps) or offset_s, float(cameras[0]), float(sweeps[0]))


def _known_gap_s(cameras: NDArray[np.float64], sweeps: NDArray[np.float64]) -> float | None:
    """The known difference of clocks with which nearly every image of a selection, whose intervals are long, has a
    sweep; None if none does, or several do."""
    known_s = (*TIME_SCALES_S, *(3600.0 * hours for hours in range(1, MOST_HOURS)))
    compared = cameras[:: max(1, len(cameras) // COMPARED)]
    fitting = [
        gap_s
        for gap_s in (sign * known for known in known_s for sign in (-1.0, 1.0))
        if np.mean([np.abs(sweeps - stamp_s - gap_s).min() < PARTNER_S for stamp_s in compared]) >= FITTING
    ]
    return fitting[0] if len(fitting) == 1 and len(cameras) >= FEWEST_STAMPS else None


def clock_separation_text(camera_stamps_ns: Sequence[int], sweep_stamps_ns: Sequence[int]) -> str:
    """As `clocks_text`, if the clouds begin and end one known difference of clocks before or after the images, so that
    frames that find a sweep find a wrong one; empty otherwise."""
    if min(len(camera_stamps_ns), len(sweep_stamps_ns)) < FEWEST_STAMPS:
        return ""
    cameras, sweeps = (np.array(stamps, dtype=np.float64) * 1e-9 for stamps in (camera_stamps_ns, sweep_stamps_ns))
    begin_s, end_s = float(sweeps[0] - cameras[0]), float(sweeps[-1] - cameras[-1])
    # A recorder ends all streams at once; sensors may take a while to start.
    period_s = max(float(np.median(np.diff(stamps_s))) for stamps_s in (cameras, sweeps))
    if period_s > LONGEST_PERIOD_S:
        return ""
    within_s = 0.5 + period_s
    known_s = (*TIME_SCALES_S, *(3600.0 * hours for hours in range(1, 15)))
    signed_s = (sign * gap_s for gap_s in known_s for sign in (-1.0, 1.0))
    separation_s = min(signed_s, key=lambda gap_s: abs(end_s - gap_s))
    if abs(end_s - separation_s) > within_s or abs(begin_s - separation_s) > within_s + STARTING_S:
        return ""
    return _offset_text(separation_s, float(cameras[0]), float(sweeps[0]))


STAMPS_IRREGULAR = "stamps_irregular"
"""Code of the recognition that the stamps of a stream are irregular."""

LEAST_IRREGULAR, LEAST_IRREGULAR_S, LEAST_INTERVALS = 0.15, 0.008, 20
"""Stamps are irregular if half of their intervals are farther than both from whole multiples of the period: as a share
of the period, and s. Fewer intervals show no period."""


def irregular_stamps_text(stamps_ns: Mapping[str, Sequence[int]]) -> str:
    """Which of the streams, by name, has irregular stamps, though no frame need be lost; empty if none has."""
    for name, of_stream in stamps_ns.items():
        intervals_s = np.diff(np.array(of_stream, dtype=np.float64)) * 1e-9
        period_s = float(np.median(intervals_s)) if len(intervals_s) >= LEAST_INTERVALS else 0.0
        if not 0.0 < period_s < 0.5:  # sparser frames are a selection
            continue
        off_s = float(np.median(np.abs(intervals_s - period_s * np.maximum(np.rint(intervals_s / period_s), 1.0))))
        if off_s > max(LEAST_IRREGULAR * period_s, LEAST_IRREGULAR_S):
            return (
                f"The stamps of the {name} are irregular: at {1.0 / period_s:.1f} Hz, half of their intervals are "
                f"{1e3 * off_s:.0f} ms or more from a whole number of periods, so that images and sweeps do not belong "
                "to their stamps. They are probably times of receipt: let the driver stamp when it measures (hardware "
                "time, trigger), and record again."
            )
    return ""


def _offset_text(offset_s: float, camera_s: float, sweep_s: float) -> str:
    cause = offset_cause(offset_s, camera_s, sweep_s)
    # Only a difference of time scales is known exactly; streams begin up to a frame apart.
    exact = any(abs(abs(offset_s) - gap_s) < 0.5 for gap_s in TIME_SCALES_S)
    added = f"{-round(offset_s):d}" if exact else "SECONDS"
    return (
        f"the clouds are {abs(offset_s):.3f} s {'ahead of' if offset_s > 0 else 'behind'} the images{cause}: "
        f"the images begin at {_begin(camera_s)}, the clouds at {_begin(sweep_s)}. The stamps must be of one clock: "
        "let both drivers take the computer's time, or synchronise the sensors (PTP), and record again; where the "
        f"difference is known, correct the stamps of one stream, of a bag with ?lidar_offset={added}, which is added "
        "to those of the clouds"
    )


def _begin(stamp_s: float) -> str:
    """A stamp as a date; as seconds if it is none."""
    if not EPOCH_S < stamp_s < YEAR_2100_S:
        return f"{stamp_s:.3f} s"
    return datetime.fromtimestamp(stamp_s, UTC).isoformat(" ", "milliseconds").removesuffix("+00:00")


TIME_SCALES_S = {
    37.0: "TAI - UTC (PTP without its UTC offset)",
    18.0: "GPS time - UTC",
    19.0: "TAI - GPS time",
    315_964_782.0: "what GPS time, which counts from 1980, lacks to time since 1970",
    315_964_800.0: "what GPS time, which counts from 1980, lacks to time since 1970, without its leap seconds",
}
"""Differences of time scales, s, since 2017."""

MOST_HOURS = 26
"""Time zones are up to so far apart."""

PARTNER_S, FITTING, COMPARED = 0.1, 0.9, 40
"""An image has a sweep within this time, s, by a difference of clocks that this share of them shows, of about so many
images."""

LATE_S = 0.5
"""Messages arrive within this time."""

START_S = 1.0
"""Streams of one recording begin within this time."""

STARTING_S = 5.0
"""A sensor may take so much longer than another to start."""

LONGEST_PERIOD_S = 2.5
"""Streams that are sparser, as of a selection of frames, do not show when they begin and end."""

FEWEST_STAMPS = 3
"""Fewer frames of a stream show no begin and no end."""

YEAR_2100_S = 4.1e9
"""Later stamps are none."""

EPOCH_S = 1e8
"""Stamps below count from the start of a computer, not from 1970."""


def offset_cause(offset_s: float, camera_s: float, sweep_s: float) -> str:
    """What the difference `offset_s` of two streams looks like that begin at `camera_s` and `sweep_s`, in brackets;
    empty if it looks like nothing known."""
    smaller, larger = sorted((camera_s, sweep_s))
    for power, unit in ((3, "microseconds"), (6, "milliseconds"), (9, "seconds")):
        if larger > EPOCH_S and smaller > 0.0 and 0.9 < larger / smaller / 10**power < 1.1:
            return f" (the stamps of one stream are probably {unit}, not nanoseconds)"
    if smaller < EPOCH_S < larger:
        return " (one stream counts from the start of a computer, the other from 1970)"
    hours = round(offset_s / 3600.0)
    if 0 < abs(hours) <= MOST_HOURS and abs(offset_s - 3600.0 * hours) < START_S:
        return f" (whole hours, {hours:+d}: one driver probably stamps in local time)"
    if abs(offset_s) < LATE_S:
        return " (one of the two is probably stamped when it was received, not when it was measured)"
    scale = next((name for gap_s, name in TIME_SCALES_S.items() if abs(abs(offset_s) - gap_s) < 0.5), None)
    return "" if scale is None else f" (this is {scale})"


SEPARATE_S = 10.0
"""Clocks that are less far apart may be one, because messages may be received late."""


def header_clock_text(lags_s: Mapping[str, Sequence[float]], first_stamps_s: Mapping[str, float]) -> str:
    """Which topic has stamps of another clock than the recorder's, though those of another topic follow that; empty if
    none has. Stamps of one clock that is not the recorder's, as of a simulation, do no harm.

    Args:
        lags_s: by topic, seconds from the stamp of each message until the recorder received it.
        first_stamps_s: by topic.
    """
    # Times that a tool wrote, and no recorder, do not follow the stamps.
    steady = {topic: np.quantile(lags, (0.1, 0.5, 0.9)) for topic, lags in lags_s.items() if len(lags) >= FEWEST_STAMPS}
    medians_s = {topic: float(middle) for topic, (low, middle, high) in steady.items() if high - low < START_S}
    if not medians_s:
        return ""
    reference = min(medians_s, key=lambda topic: abs(medians_s[topic]))
    offset_s, other = max(
        ((medians_s[reference] - lag_s, topic) for topic, lag_s in medians_s.items()), key=lambda one: abs(one[0])
    )
    if abs(offset_s) < SEPARATE_S:
        return ""
    cause = offset_cause(offset_s, first_stamps_s[reference], first_stamps_s[other])
    return (
        f"the stamps on {other} are {abs(offset_s):.1f} s {'ahead of' if offset_s > 0 else 'behind'} the clock of the "
        f"recorder, which those on {reference} follow{cause}: let the driver of {other} take the computer's time, or "
        "synchronise the sensor (PTP, with its UTC offset)"
    )
