"""What `coec diagnose` says of one check, in words: what is wrong, how far, what it cannot tell, and what to do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from coec.calibration.monitor.change_detector import Observation
from coec.reports import console

TELLING = 2.0
"""Standard deviations from which an axis is named as one that is off: on one axis in twenty chance does as much."""

SEEN = 3.0
"""Standard deviations of a check below which it would not notice that a mount has moved."""

NAMES = ("pitch", "yaw", "roll", "right", "down", "forward")
"""Of turns about, and shifts along, the axes of the camera."""


@dataclass(frozen=True, slots=True)
class Finding:
    """`state`: right, moved, unclear, or bad_data. `sentence` says what is the case; `remarks` what it rests on, what
    it leaves open, and what to do."""

    state: str
    sentence: str
    remarks: tuple[str, ...]


STYLES = {"right": "bold green", "moved": "bold red", "unclear": "bold yellow", "bad_data": "bold red"}


def finding_of(seen: Observation, offset: Sequence[float], sigma: Sequence[float]) -> Finding:
    """Of one check; `offset` (6,) from the pose that was asked about to where the edges fit, and its standard
    deviations, degrees and metres."""
    if seen.causes:
        texts = tuple(f"{cause.code}: {cause.text}" for cause in seen.causes)
        advice = tuple(dict.fromkeys(cause.advice for cause in seen.causes))
        then = "Then ask again: with such data no check tells whether the mount has moved."
        return Finding("bad_data", "the data is wrong, not necessarily the mount", (*texts, *advice, then))
    least = max(SEEN * value for value in sigma[:3])
    faint = ("The edges are faint: in the service this check would count for little.",) if seen.weak else ()
    if seen.flagged:
        return Finding(
            "moved",
            f"mount moved: {moved_text(offset, sigma)}",
            (
                *faint,
                "That is the nearest place at which the edges fit: `coec calibrate` measures it, from far away too, "
                "and says how sure it is.",
                "Of one pair it cannot be told whether the camera or the LiDAR moved: look at both mounts, then "
                "calibrate, and serve what is accepted.",
            ),
        )
    if seen.undecided:
        return Finding(
            "unclear",
            f"cannot tell: the edges fit best at {moved_text(offset, sigma)}, but hardly worse where they are",
            (*faint, "Take a longer recording, in motion, with poles and corners in view, or run `coec calibrate`."),
        )
    return Finding(
        "right",
        "the extrinsic is right, as far as one check tells",
        (*faint, f"A mount that moved by less than {least:.2f}° about any axis would not be seen in it."),
    )


def moved_text(offset: Sequence[float], sigma: Sequence[float]) -> str:
    """The axes that are off by more than chance would have it, farthest first; if none is, the farthest."""
    told = [
        (abs(value) / spread, axis)
        for axis, (value, spread) in enumerate(zip(offset, sigma, strict=True))
        if spread > 0.0
    ]
    far = sorted((distance, axis) for distance, axis in told if distance >= TELLING) or [max(told)]
    return ", ".join(_axis_text(axis, offset[axis], sigma[axis]) for _, axis in reversed(far))


def show(finding: Finding) -> None:
    """In its colour, the remarks below."""
    console.show(finding.sentence, STYLES[finding.state])
    for remark in finding.remarks:
        console.show(f"  {remark}")


def _axis_text(axis: int, value: float, spread: float) -> str:
    if axis < 3:
        return f"{NAMES[axis]} {_signed(value, 1 if spread >= 0.05 else 2)}° ± {spread:.2f}°"
    return f"{NAMES[axis]} {_signed(value, 2)} m ± {spread:.2f} m"


def _signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")
