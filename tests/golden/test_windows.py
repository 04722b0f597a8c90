"""Of the same window the same is decided, to the byte: each lens, objective and number of degrees of freedom."""

from __future__ import annotations

import pytest

from golden.reference import Tolerance, differences, is_identical, read, write
from golden.windows import CASES, FILE, Windows, fields_that_differ

LOOSE = Tolerance(relative=0.1, absolute=0.01, counts=1e-3)
"""Of results on another kind of processor: the search ends a little beside (measured without vector instructions: 6 %
of a standard deviation, 0.005° of a correction, 4 of 120,000 points)."""

ONLY_NEAR = "intrinsics_off"
"""A figure that is there or not by what the edges tell of the lens, which a last digit may decide."""

FLAT = ("network mi",)
"""Windows that are refused because their objective has no summit: the last digits of a depth network move the end of
the search by more than a standard deviation."""

ALONG_THE_FLAT = ("correction", "figures", "sigma")
"""Values of such windows that are compared on the same kind of processor only."""


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> Windows:
    return Windows(tmp_path_factory.mktemp("drives"))


@pytest.fixture(scope="module", autouse=True)
def _forgets(writes: bool) -> None:
    if writes:
        write(FILE, {})


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if case.fast else pytest.mark.slow) for name, case in CASES.items()]
)
def test_the_same_is_decided_of_the_same_window(name: str, windows: Windows, writes: bool) -> None:
    now = windows.decide(CASES[name])
    if writes:
        write(FILE, {**read(FILE), name: now})
    golden = read(FILE)[name]
    hashes = ("sha256", "fields")
    before, after = ({key: of[key] for key in of if key not in hashes} for of in (golden, now))
    if not is_identical():
        for one in (before, after):
            one["values"]["figures"].pop(ONLY_NEAR, None)
            for value in ALONG_THE_FLAT if name in FLAT else ():
                del one["values"][value]
    assert not differences(before, after, Tolerance() if is_identical() else LOOSE)
    if is_identical():
        other = fields_that_differ(golden, now)
        assert golden["sha256"] == now["sha256"], f"values are equal when rounded; fields that differ: {other}"


def test_every_objective_and_verdict_is_in_the_fast_form() -> None:
    fast = [name for name, case in CASES.items() if case.fast]
    assert len({CASES[name].drive.lens for name in fast}) > 3
    for option, values in (("objective", {"fused", "mi", "intensity"}), ("dof", {3, 6})):
        assert {CASES[name].options[option] for name in fast} == values
    assert {read(FILE)[name]["values"]["decision"] for name in fast} == {"accepted", "failed"}


def test_there_is_a_golden_decision_of_every_window_and_no_other() -> None:
    assert set(read(FILE)) == set(CASES)
