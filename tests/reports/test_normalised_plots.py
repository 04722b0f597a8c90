"""Figures of normalised errors: that they are drawn whatever was claimed, and always the same."""

from __future__ import annotations

import numpy as np

from coec_lab.experiments.plots import normalised
from coec_lab.experiments.solve_statistics import Claims, gathered, normalise
from reports.test_plots import _size

ERRORS = np.random.default_rng(1).normal(size=(40, 6))
RESULT = normalise(Claims(ERRORS, np.tile(np.eye(6), (40, 1, 1)), refused=2), 40)
NOTHING = normalise(gathered([None]), 1)


def test_every_reference_has_its_row() -> None:
    one, two = normalised({"truth": RESULT}, "title"), normalised({"truth": RESULT, "halves": NOTHING}, "title")
    assert _size(two)[1] > 1.8 * _size(one)[1]


def test_equal_figures_are_equal_bytes() -> None:
    assert normalised({"truth": RESULT}, "title") == normalised({"truth": RESULT}, "title")
