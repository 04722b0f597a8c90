"""One simulated drive in each format that is read: the decision is that of the native form, to the byte where the
format is lossless, and within a standard deviation where it is not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import coec
from support.drive_formats import LOSSLESS, LOSSY, NATIVE

pytestmark = pytest.mark.slow

PERTURBED = (1.0, -1.0, 0.5)


@dataclass(frozen=True, slots=True)
class Decision:
    """What is compared: all of the result, and the rotation with its standard deviations."""

    accepted: bool
    document: str
    rotation: NDArray[np.float64]
    sigma: NDArray[np.float64]

    def distance(self, native: Decision) -> float:
        """The largest distance to the native one, standard deviations."""
        return float((np.abs(self.rotation - native.rotation) / native.sigma).max())


def decided(source: str) -> Decision:
    result = coec.open(source).calibrate(perturb=PERTURBED)
    return Decision(result.accepted, result.to_json(), result.correction[:3], result.sigma[:3])


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Decision]:
    """The decisions of the native forms, each made once."""
    made: dict[str, Decision] = {}

    def decision(form: str) -> Decision:
        if form not in made:
            made[form] = decided(NATIVE[form](tmp_path_factory.mktemp("native")))
        return made[form]

    return decision


@pytest.mark.parametrize("form", LOSSLESS)
def test_a_lossless_format_gives_the_same_decision_to_the_byte(
    tmp_path: Path, native: Callable[[str], Decision], form: str
) -> None:
    of, write = LOSSLESS[form]
    assert decided(write(tmp_path)).document == native(of).document


@pytest.mark.parametrize("form", LOSSY)
def test_a_lossy_format_gives_the_decision_within_a_standard_deviation(
    tmp_path: Path, native: Callable[[str], Decision], form: str, record_property: Callable[[str, object], None]
) -> None:
    of, write = LOSSY[form]
    decision = decided(write(tmp_path))
    assert decision.accepted
    assert native(of).accepted
    distance = decision.distance(native(of))
    record_property("figure", f"{form}: {distance:.2f} standard deviations")
    assert distance < 1.0
