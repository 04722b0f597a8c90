"""Where depth comes from: maps of the frames, networks by file and by name, and the cache."""

import pwd
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.types import CameraFrame, DepthMap
from coec.config import DepthConfig, LimitsConfig
from coec.errors import DecodeError, ModelError
from coec.io.depth.depth_maps import CachedDepth, PrecomputedDepth, models_folder, open_depth
from coec.io.images import encode_depth_png, encode_png, probe
from support.recordings import MODEL_CARD, first_channel_network

LIMITS = LimitsConfig()


def _frame(grey: int, depth_code: int | None = None) -> CameraFrame:
    image = probe(encode_png(np.full((32, 32, 3), grey, np.uint8)), LIMITS)
    if depth_code is None:
        return CameraFrame(7, "camera", image)
    codes = np.array([[depth_code, 0], [3, 65535]], dtype=np.uint16)
    return CameraFrame(7, "camera", image, depth=probe(encode_depth_png(codes), LIMITS))


class _Counting:
    """A depth model that counts how often it is asked."""

    identity = "counting"

    def __init__(self) -> None:
        self.calls = 0

    def infer(self, frame: CameraFrame) -> DepthMap:
        if frame.image.width != 32:
            raise DecodeError("image_corrupt", "not of this test")
        self.calls += 1
        return DepthMap(np.full((2, 2), self.calls, dtype=np.float32))


def test_precomputed_maps_come_as_they_are_with_nan_for_no_value() -> None:
    model = open_depth(DepthConfig(model="stereo"), LIMITS)
    assert isinstance(model, PrecomputedDepth)
    assert model.identity == "precomputed"
    np.testing.assert_array_equal(model.infer(_frame(1, 9)).values, [[9, np.nan], [3, 65535]])


def test_frame_without_map_is_refused_by_reason() -> None:
    with pytest.raises(DecodeError, match="7 ns carries no depth map") as caught:
        PrecomputedDepth(LIMITS).infer(_frame(1))
    assert caught.value.reason == "depth_missing"


def test_network_is_opened_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "net.onnx"
    path.write_bytes(first_channel_network())
    path.with_suffix(".yaml").write_text(MODEL_CARD)
    model = open_depth(DepthConfig(model=str(path)), LIMITS)
    np.testing.assert_array_equal(model.infer(_frame(5)).values, np.full((32, 32), 5))


def test_network_is_opened_by_the_name_of_its_card(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    models_folder().mkdir(parents=True)
    (models_folder() / "midas_small.onnx").write_bytes(first_channel_network())
    model = open_depth(DepthConfig(model="midas_small"), LIMITS)
    assert model.infer(_frame(5)).values.shape == (256, 256)


@pytest.mark.fault(
    "a user without a home, as a service manager makes them up", "networks of the package can still be opened"
)
def test_a_user_without_a_home_has_the_networks_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody(uid: int) -> None:
        raise KeyError(f"getpwuid(): uid not found: {uid}")

    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    monkeypatch.delenv("HOME", raising=False)
    monkeypatch.setattr(pwd, "getpwuid", nobody)
    assert open_depth(DepthConfig(model="street"), LIMITS).identity
    with pytest.raises(ModelError, match=r"there is no depth network ~/mine\.onnx"):
        open_depth(DepthConfig(model="~/mine.onnx"), LIMITS)


def test_known_network_is_detected_by_name_under_its_customary_file_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sample_data: Path
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    models_folder().mkdir(parents=True)
    source = sample_data / "depth" / "tcsmallnet_dyn.onnx"
    (models_folder() / source.name).write_bytes(source.read_bytes())
    model = open_depth(DepthConfig(model="tcmonodepth_small"), LIMITS)
    assert model.identity == "4caa795b60b9857f2b7b10ad6a76c7ddfcfadcf717121419f629fd4ba38e6099"


def test_wrong_file_under_the_name_of_a_known_network_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    models_folder().mkdir(parents=True)
    (models_folder() / "tcmonodepth_small.onnx").write_bytes(first_channel_network())
    with pytest.raises(ModelError, match="its card tcmonodepth_small is for 4caa795b"):
        open_depth(DepthConfig(model="tcmonodepth_small"), LIMITS)


@pytest.mark.parametrize("model", ["no_such_name", "missing/net.onnx"])
def test_an_unknown_network_is_refused_with_those_that_are_there(
    model: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(ModelError, match=f"there is no depth network {model}: .*on this machine: street\\."):
        open_depth(DepthConfig(model=model), LIMITS)


def test_a_known_network_without_its_file_reports_where_it_was_searched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    with pytest.raises(
        ModelError, match=f"midas_small is not .*{tmp_path}/coec/models/midas_small.onnx.*isl-org/MiDaS"
    ):
        open_depth(DepthConfig(model="midas_small"), LIMITS)


def test_cache_requests_once_per_content() -> None:
    inner = _Counting()
    cached = CachedDepth(inner, entries=4)
    first = cached.infer(_frame(1))
    assert cached.infer(_frame(1)) is first
    assert inner.calls == 1
    cached.infer(_frame(2))
    cached.infer(_frame(1, depth_code=5))  # the map is part of the content
    assert inner.calls == 3
    assert cached.identity == "counting"


def test_cache_drops_what_was_not_requested_the_longest() -> None:
    inner = _Counting()
    cached = CachedDepth(inner, entries=2)
    for grey in (1, 2, 1, 3):  # 3 drives out 2
        cached.infer(_frame(grey))
    assert inner.calls == 3
    cached.infer(_frame(1))
    assert inner.calls == 3
    cached.infer(_frame(2))
    assert inner.calls == 4


def test_cache_remembers_no_failure() -> None:
    cached = CachedDepth(_Counting(), entries=2)
    odd = CameraFrame(0, "camera", probe(encode_png(np.zeros((8, 8, 3), np.uint8)), LIMITS))
    for _ in range(2):
        with pytest.raises(DecodeError):
            cached.infer(odd)


def test_cache_needs_room() -> None:
    with pytest.raises(ValueError, match="at least 1"):
        CachedDepth(_Counting(), entries=0)
