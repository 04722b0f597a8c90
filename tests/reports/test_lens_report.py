"""The lens for people: as given, as estimated, and what to do."""

from __future__ import annotations

import pytest

from coec.reports import lens_report
from coec.reports.page import Table
from coec.schemas.replies import Intrinsics, Lens, LensDrift, LensTerm

GIVEN = Intrinsics(
    model="pinhole", width=1400, height=400, parameters={"fx": 550.0, "fy": 560.0, "cx": 700.0, "cy": 200.0}
)


def term(difference: float, sigma: float, unit: str = "px", *, determined: bool = True) -> LensTerm:
    return LensTerm.model_validate(
        {
            "unit": unit,
            "difference": difference,
            "sigma": sigma,
            "free_difference": 2.0 * difference,
            "free_sigma": 3.0 * sigma,
            "determined": determined,
        }
    )


def lens(focal: float = 0.001, right: float = -0.5, radial: float = 0.2, probability: float = 0.02) -> Lens:
    return Lens(
        focal_length=term(focal, 0.002, "share"),
        principal_point_x=term(right, 1.0),
        principal_point_y=term(0.3, 1.5, determined=False),
        radial=term(radial, 1.0),
        probability=probability,
        estimated={"fx": 550.55, "fy": 560.56, "cx": 699.5, "cy": 200.3},
    )


def test_every_parameter_is_next_to_the_given_one_in_pixels_and_sigma() -> None:
    fx, _, cx, cy, radial = lens_report.rows_of(lens(), GIVEN)
    assert fx == ("fx", "550.00", "550.55", "1.10", "+0.5", "551.10", "3.30", "px")
    assert cx[1:5] == ("700.00", "699.50", "1.00", "−0.5")
    assert cy[5:7] == ("not determined", "")
    assert radial[:4] == ("radial, at a corner", "0.00", "0.20", "1.00")


def test_a_lens_as_given_gets_no_advice() -> None:
    (sentence,) = lens_report.remarks(lens(), GIVEN)
    assert "2.0 %" in sentence


@pytest.mark.parametrize(
    ("changes", "advice"),
    [
        ({"focal": 0.05}, "not of another size"),
        ({"right": 40.0}, "a crop"),
        ({"radial": 9.0}, "with a target"),
        ({}, "`fx: 550.55, fy: 560.56, cx: 699.50, cy: 200.30` under `camera:`"),
    ],
)
def test_another_lens_gets_advice_and_the_values_to_write(changes: dict[str, float], advice: str) -> None:
    assert any(advice in sentence for sentence in lens_report.remarks(lens(probability=0.9, **changes), GIVEN))
    small = {"focal": 0.001, "right": 4.0, "radial": 0.2} | changes
    others = {"not of another size", "a crop", "with a target"} - {advice}
    sentences = lens_report.remarks(lens(probability=0.9, **small), GIVEN)
    assert not any(other in sentence for other in others for sentence in sentences)


def test_what_was_not_estimated_is_reported(capsys: pytest.CaptureFixture[str]) -> None:
    lens_report.show(None, GIVEN)
    assert "not estimated" in capsys.readouterr().out
    (text,) = lens_report.section(None, GIVEN).blocks
    assert "not estimated" in str(text)


def test_the_page_has_the_same_table_as_the_console(capsys: pytest.CaptureFixture[str]) -> None:
    lens_report.show(lens(), GIVEN)
    shown = capsys.readouterr().out
    table = lens_report.section(lens(), GIVEN).blocks[0]
    assert isinstance(table, Table)
    assert all(cell in shown for row in table.rows for cell in map(str, row))


def test_the_drift_of_a_vehicle_is_one_line() -> None:
    drift = LensDrift(**dict(lens()), window_id="front-7", data_stamp_ns=7)
    text = lens_report.drift_text(drift)
    assert text.startswith("focal length +0.10 ± 0.20 %, principal point right −0.5 ± 1.0 px")
    assert text.endswith("another lens with probability 2.0 % (window front-7)")
