"""`check-config`, `convert OUT.yaml`, and the commented form of a configuration."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from cli.conftest import SMALL, Coec
from coec.cli.check_config import example, template
from coec.cli.convert import configuration_for
from coec.config import Config, config_hash, load_config
from coec.errors import ConfigError
from coec.reports.commented_yaml import commented_yaml
from coec.simulation.source import open_sim
from conftest import REPOSITORY


def _read(text: str, folder: Path) -> Config:
    path = folder / "read.yaml"
    path.write_text(text)
    return load_config(path)


def test_deployed_example_is_the_template() -> None:
    assert (REPOSITORY / "deploy" / "coec.yaml").read_text() == template()


def test_template_reads_back_to_the_example(tmp_path: Path) -> None:
    assert _read(template(), tmp_path) == example()


def test_template_names_every_key() -> None:
    text = template()
    document = example().model_dump()
    missing = []

    def visit(value: object) -> None:
        if isinstance(value, dict):
            for name, below in value.items():
                if below is not None and f"{name}:" not in text:
                    missing.append(name)
                visit(below)
        elif isinstance(value, tuple):
            for item in value:
                visit(item)

    visit(document)
    assert missing == []


@pytest.mark.parametrize("key", ["a//b", "a/", "/a", "a/*", "a b", ""])
def test_what_zenoh_takes_for_no_key_is_refused(tmp_path: Path, key: str) -> None:
    text = template().replace("key: sensors/front/lidar", f'key: "{key}"')
    assert text != template()
    with pytest.raises(ConfigError, match=r"lidar\.key"):
        _read(text, tmp_path)


def test_defaults_prints_the_template(coec: Coec) -> None:
    outcome = coec("check-config", "--defaults")
    assert outcome.status == 0
    assert outcome.out == template()


def test_effective_configuration_is_complete_and_hashed(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "coec.yaml"
    assert coec("convert", SMALL, path).status == 0
    outcome = coec("check-config", path)
    config = load_config(path)
    assert outcome.status == 0
    assert _read(outcome.out, tmp_path) == config
    assert f"# config hash {config_hash(config)}" in outcome.out
    document = coec("check-config", path, "--json").document
    assert document["config_hash"] == config_hash(config)
    assert Config.model_validate(document["config"]) == config


def test_converted_configuration_fits_the_recording(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "coec.yaml"
    written = coec("convert", SMALL, path, "--json").document["written"]
    (pair,) = load_config(path).pairs
    assert written == [str(tmp_path / "coec-mask.png"), str(path)]
    assert pair.name == "sim"
    assert pair.camera.key == "sensors/sim/camera"
    assert pair.camera.mask == tmp_path / "coec-mask.png"
    assert pair.camera.intrinsics.model == "double_sphere"
    assert pair.ego is not None
    # Six frames cannot make the ten that a window needs by default.
    assert pair.window.min_pairs == 3


@pytest.mark.parametrize(
    ("seconds", "hertz", "slice_s", "min_pairs"),
    [("60", "1", 29.5, 10), ("600", "1", 180.0, 10), ("600", "0.1", 180.0, 10), ("30", "0.2", 180.0, 3)],
    ids=["a minute", "ten minutes", "sparse", "few frames"],
)
def test_the_window_is_one_that_the_recording_fills(seconds: str, hertz: str, slice_s: float, min_pairs: int) -> None:
    query = {"seconds": seconds, "camera_hz": hertz, "lidar_hz": hertz, "camera": "fisheye64", "lidar": "16"}
    recording = open_sim(query)
    window = configuration_for(recording, recording.T_camera_lidar_start, None).window
    assert window.slice_s == pytest.approx(slice_s)
    assert window.min_pairs == min_pairs
    # As many pairs as it takes, were they all good.
    bin_s = window.slice_s / window.pairs
    bins = {int((stamp_ns - recording.camera_stamps_ns[0]) / 1e9 / bin_s) for stamp_ns in recording.camera_stamps_ns}
    assert len(bins) >= window.min_pairs


@pytest.mark.parametrize(
    ("before", "after", "complaint"),
    [
        ("vehicle: vehicle", "vehicel: vehicle", "vehicel"),
        ("mask: coec-mask.png", "mask: absent.png", "absent.png"),
        ("model: stereo", "model: absent.onnx", "absent.onnx"),
        ("  - [0.0, 0.0, 0.0, 1.0]", "  - [0.0, 0.0, 0.0, 2.0]", "not a rigid transform"),
    ],
)
def test_unusable_configuration_is_78(coec: Coec, tmp_path: Path, before: str, after: str, complaint: str) -> None:
    path = tmp_path / "coec.yaml"
    coec("convert", SMALL, path)
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    outcome = coec("check-config", path)
    assert outcome.status == 78
    assert complaint in outcome.err


def test_file_or_defaults(coec: Coec) -> None:
    assert coec("check-config").status == 2


def test_scalars_survive(tmp_path: Path) -> None:
    config = example().model_copy(update={"vehicle": "null", "stale_after_s": 1e-7})
    assert _read(commented_yaml(config), tmp_path) == config
    assert YAML(typ="safe").load(commented_yaml(config))["vehicle"] == "null"


def test_run_refuses_a_bad_configuration_before_anything_starts(coec: Coec, tmp_path: Path) -> None:
    path = tmp_path / "coec.yaml"
    path.write_text("pairs: []\n")
    outcome = coec("run", "--config", path)
    assert outcome.status == 78
    assert "pairs" in outcome.err
