"""A simulated drive by its words."""

import sys

import pytest

from coec.errors import SourceError, UsageError
from coec.io.recordings.layouts import open_source
from coec_lab.simulation import source


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("sim:sead=1", "unknown query key sead"),
        ("sim:seed=x", "seed=x"),
        ("sim:seconds=0", "seconds=0"),
        ("sim:camera=box", "fisheye700"),
        ("sim:lidar=63", "choose one of 64, 32, 16, 128, raster, rosette"),
        ("sim:intensity=loud", "choose one of calibrated, reflectivity, raw, coarse, none"),
        ("sim:workshop=1,2", "rx,ry,rz"),
        ("sim:depth=maybe", "yes or no"),
        ("sim:faults=rust:3", "unknown fault"),
        ("sim:faults=rain:3:mmph=500", "between 0 and 150"),
        ("sim:faults=offset_drift:3", "needs an end"),
        ("sim:camera=pinhole64x64@170", "10 to 120"),
        ("sim:scene=moon", "choose one of street, highway, garage, room"),
        ("sim:scene=room&faults=tunnel:0-5", "a stretch of a street, not of a room"),
        ("sim:speed_mps=0&faults=tunnel:0-5", "give it a speed"),
        ("sim:speed_mps=50", "speed_mps=50"),
        ("sim:traffic=some", "yes or no"),
        ("sim:intrinsics_off=1,2", "FOCAL,CX,CY"),
        ("sim:intrinsics_off=30", "20 at most"),
    ],
)
def test_what_does_not_fit_is_refused(text: str, reported: str) -> None:
    pytest.importorskip("embreex", reason="needs embreex")
    with pytest.raises(UsageError, match=reported):
        open_source(text)


def test_without_embree_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(SourceError, match=r"pip install coec-lab"):
        source.open_sim({})


def test_the_question_mark_may_be_left_out() -> None:
    pytest.importorskip("embreex", reason="needs embreex")
    for text in ("sim:seed=3&seconds=1&camera=fisheye64&lidar=16", "sim:?seed=3&seconds=1&camera=fisheye64&lidar=16"):
        recording = open_source(text)
        assert recording.name == "simulated drive, seed 3"
        assert len(recording.camera_stamps_ns) == 10
        assert recording.rig.camera.width == 64
