"""Faults: their words, and what they do to the mount."""

import math

import numpy as np
import pytest

from coec.errors import UsageError
from coec.geometry.se3 import difference
from coec_lab.simulation import faults
from coec_lab.simulation.faults import parse_fault, shifted


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("step:30:rx=3,tz=0.1", faults.StepFault(30, math.inf, rx=3, tz=0.1)),
        ("step:30-40:ry=-1.5", faults.StepFault(30, 40, ry=-1.5)),
        ("drift:10-20:rz=2", faults.DriftFault(10, 20, rz=2)),
        ("dirt:5", faults.Dirt(5, math.inf)),
        ("dark:5-6:light=0.1", faults.Dark(5, 6, light=0.1)),
        ("swing:10-20:rx=1.5,period_s=2.3", faults.Swing(10, 20, rx=1.5, period_s=2.3)),
        ("frozen:1-2", faults.Frozen(1, 2)),
        ("lidar_frozen:1-2", faults.LidarFrozen(1, 2)),
        ("beams:1-2:share=0.25", faults.Beams(1, 2, share=0.25)),
        ("no-ego:1-2", faults.NoEgo(1, 2)),
        ("zero-ego:1-2", faults.ZeroEgo(1, 2)),
        ("offset:1-2:seconds=-0.1", faults.StampOffset(1, 2, seconds=-0.1)),
        ("loss:0:share=1", faults.Loss(0, math.inf, share=1)),
        ("tunnel:20-35", faults.Tunnel(20, 35)),
        ("open_road:20", faults.OpenRoad(20, math.inf)),
        ("night:1-2", faults.Night(1, 2)),
    ],
)
def test_the_text_of_a_fault(text: str, expected: faults.Fault) -> None:
    assert parse_fault(text) == expected


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("rust:3", "unknown fault 'rust'"),
        ("step", "begin must be a number, not ''"),
        ("step:x:rx=1", "begin must be a number"),
        ("step:5-4:rx=1", "end after that"),
        ("step:-1:rx=1", "begin must be a number"),
        ("step:1:roll=1", "unknown setting 'roll'; it takes rx, ry, rz, tx, ty, tz"),
        ("step:1:rx=much", "rx must be a number"),
        ("step:1:rx=nan", "rx must be a number"),
        ("drift:1:rx=1", "drift needs an end"),
        ("frozen:1:share=1", "it takes no settings"),
        ("tunnel:1:light=1", "it takes no settings"),
        ("loss:1:share=2", "share must lie between 0 and 1"),
        ("swing:1:rx=1,period_s=0", "period_s must be 0.01 or more"),
    ],
)
def test_what_does_not_fit_is_refused_with_an_example(text: str, reported: str) -> None:
    with pytest.raises(UsageError, match=r"step:30:rx=3|between 0 and 1|drift:30-90|or more") as refused:
        parse_fault(text)
    assert reported in str(refused.value)


def test_every_example_of_the_help_is_understood() -> None:
    kinds = {type(parse_fault(text)) for text in faults.FORMS.split(" | ")}
    assert kinds == set(faults.KINDS.values())


def test_a_step_lasts_and_a_drift_stays() -> None:
    start = np.eye(4)
    both = (parse_fault("step:10-20:rx=3"), parse_fault("drift:0-40:ty=0.4"))
    assert np.array_equal(shifted(start, both, 0.0), start)
    np.testing.assert_allclose(difference(shifted(start, both, 5.0), start), [0, 0, 0, 0, 0.05, 0], atol=1e-12)
    np.testing.assert_allclose(difference(shifted(start, both, 15.0), start)[:3], [np.deg2rad(3), 0, 0], atol=1e-12)
    np.testing.assert_allclose(difference(shifted(start, both, 99.0), start), [0, 0, 0, 0, 0.4, 0], atol=1e-12)


def test_a_loose_mount_swings_about_its_pose_until_it_is_tight_again() -> None:
    start = np.eye(4)
    loose = (parse_fault("swing:10-20:rx=1,period_s=4"),)
    about_x = [np.rad2deg(difference(shifted(start, loose, t), start)[0]) for t in (9.0, 10.0, 11.0, 12.0, 13.0, 21.0)]
    np.testing.assert_allclose(about_x, [0, 0, 1, 0, -1, 0], atol=1e-9)
