"""What windows claim, where much of it is open: on simulated drives, from starts that are wrong."""

from __future__ import annotations

import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec.config import CalibrationConfig
from coec_lab.experiments import matrix_drives
from coec_lab.experiments.matrix_drives import Settings

COVERED = 3.0
"""Standard deviations that hold an error, but for one in four hundred."""


@pytest.mark.slow
def test_a_parked_vehicle_claims_no_height_that_its_pitch_makes_up_for() -> None:
    """Ten frames of one street through 32 beams: the best pitch and height lie 0.57° and 12 cm beside."""
    (drive,) = matrix_drives.selected_drives(1, "street-parked_wide_32_day_none_s2")
    row = matrix_drives.run(drive, Settings((6,), 10, CalibrationConfig().depth.model))
    for window in row.windows["6"]:
        for error, sigma in zip(window.error, window.sigma, strict=True):
            assert error is None or sigma is None or abs(error) <= COVERED * sigma
