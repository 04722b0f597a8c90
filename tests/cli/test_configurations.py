"""`check-config`, `convert OUT.yaml`, and the commented form of a configuration."""

from __future__ import annotations

from pathlib import Path

import pytest
from ruamel.yaml import YAML

from cli.conftest import SMALL, Coec
from coec.cli.check_config import example, template
from coec.cli.convert import configuration_for
from coec.config import Config, config_hash, load_config
from coec.errors import ConfigError, OutputError
from coec.io import user_files
from coec.reports.commented_yaml import commented_yaml, short_yaml
from coec_lab.simulation.source import open_sim
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
    # Six frames in ten seconds cannot make the ten that a window needs by default, over three minutes.
    assert (pair.window.pairs, pair.window.min_pairs, pair.window.slice_s) == (6, 3, 10.0)


SHORT = "sim:seed=1&seconds=100&camera_hz=1&lidar_hz=1&camera=fisheye64&lidar=16"


@pytest.mark.parametrize("source", [SMALL, SHORT])
def test_a_converted_configuration_has_what_differs_and_what_a_person_must_see(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, source: str
) -> None:
    monkeypatch.setattr("coec_lab.simulation.source.open_sim", open_sim)  # a configuration needs no frame
    short, full = tmp_path / "a" / "coec.yaml", tmp_path / "b" / "coec.yaml"
    assert coec("convert", source, short).status == coec("convert", source, full, "--full").status == 0
    text = short.read_text()
    assert len(text.splitlines()) <= 20
    for seen in ("vehicle:", "zenoh: {connect:", "directory:", "key:", "frame_id:", "mask:", "intrinsics:"):
        assert seen in text
    assert "check-config coec.yaml" in text
    same = {"pairs": (), "state": None}
    assert load_config(short).model_copy(update=same) == load_config(full).model_copy(update=same)
    of_short, of_full = (load_config(path).pairs[0].model_dump(exclude={"camera": {"mask"}}) for path in (short, full))
    assert of_short == of_full


@pytest.mark.parametrize(
    "path", sorted((REPOSITORY / "deploy" / "examples").glob("*.yaml")), ids=lambda path: path.stem
)
def test_a_short_configuration_reads_back(tmp_path: Path, path: Path) -> None:
    config = load_config(path)
    assert _read(short_yaml(config, (), {}), tmp_path) == config
    assert _read(short_yaml(config, ("pairs.window.pairs",), {"pairs.window": "a remark"}), tmp_path) == config


@pytest.mark.parametrize("edited", ["coec.yaml", "coec-mask.png"])
def test_an_edited_file_is_not_overwritten_unless_requested(coec: Coec, tmp_path: Path, edited: str) -> None:
    path = tmp_path / edited
    path.write_text("a person's work")
    refused = coec("convert", SMALL, tmp_path / "coec.yaml")
    assert refused.status == 1
    assert f"{path} is there already" in refused.err
    assert "--force" in refused.err
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [(edited, "a person's work")]
    assert coec("convert", SMALL, tmp_path / "coec.yaml", "--force").status == 0
    assert path.read_bytes() != b"a person's work"


@pytest.mark.fault("a configuration cannot be written after its mask", "nothing is left that refuses the next try")
def test_a_failed_conversion_does_not_refuse_the_next(
    coec: Coec, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace = user_files.replace_output

    def full_disk(path: Path, data: bytes) -> Path:
        if path.suffix == ".yaml":
            raise OutputError(f"cannot write {path}: No space left on device")
        return replace(path, data)

    with monkeypatch.context() as patch:
        patch.setattr(user_files, "replace_output", full_disk)
        assert coec("convert", SMALL, tmp_path / "coec.yaml").status == 1
    assert list(tmp_path.iterdir()) == []
    assert coec("convert", SMALL, tmp_path / "coec.yaml").status == 0


@pytest.mark.parametrize(
    ("seconds", "hertz", "slice_s", "min_pairs"),
    [
        ("60", "1", 29.5, 10),
        ("100", "1", 49.5, 10),
        pytest.param("600", "1", 180.0, 10, marks=pytest.mark.slow),
        ("600", "0.1", 180.0, 10),
        ("30", "0.2", 25.0, 3),
        ("0.5", "1", 180.0, 1),
    ],
    ids=["a minute", "shorter than a slice", "ten minutes", "sparse", "few frames", "one frame"],
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
    # What follows ends the first window while the recording still goes on, or at its last frame.
    last_s = (recording.camera_stamps_ns[-1] - recording.camera_stamps_ns[0]) / 1e9
    assert window.slice_s <= last_s or last_s == 0
    assert window.pairs <= max(25, len(recording.camera_stamps_ns))


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
