"""Model cards: the built-in ones, and those that users write."""

import hashlib
from pathlib import Path

import pytest

from coec.errors import ModelError
from coec.io.depth.model_cards import FixedSize, KeepAspect, find_card, list_models, read_card
from support.recordings import MODEL_CARD

SAMPLE_NETWORKS = (
    "tcsmallnet_dyn.onnx",
    "tcmonodepth_tcsmallnet_192x320.onnx",
    "meter_xxs_kitti_192x640.onnx",
)


def _card(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "net.yaml"
    path.write_text(text)
    return path


def test_built_in_cards_are_listed_by_name() -> None:
    names = [card.name for card in list_models()]
    assert names == sorted(names)
    assert {"dpt_beit_large_512", "midas_small", "depth_anything_v2_small", "tcmonodepth_small"} <= set(names)
    assert all(card.licence and card.source for card in list_models())


@pytest.mark.parametrize("name", SAMPLE_NETWORKS)
def test_sample_networks_are_recognised_by_sha256(name: str, sample_data: Path) -> None:
    network = sample_data / "depth" / name
    card = find_card(network, hashlib.sha256(network.read_bytes()).hexdigest())
    assert card.file == name


def test_whole_card_is_read(tmp_path: Path) -> None:
    card = read_card(_card(tmp_path, MODEL_CARD))
    assert card.input.size == KeepAspect(side=32, multiple=16, fit="short")
    assert (card.input.colour_order, card.input.mean, card.input.std) == ("rgb", (0, 0, 0), (1, 1, 1))


def test_card_may_point_to_a_built_in_one(tmp_path: Path) -> None:
    card = read_card(_card(tmp_path, "card: dpt_beit_large_512\n"))
    assert card.name == "dpt_beit_large_512"
    assert card.input.mean == (0.5, 0.5, 0.5)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("card: nonsense\n", "no built-in card 'nonsense'.*midas_small"),
        ("card: midas_small\nsource: mine\n", "source: there is no such key"),
        (MODEL_CARD + "colour: rgb\n", "colour: there is no such key"),
        (MODEL_CARD.replace("scale: 1.0", "scale: 0"), "input.scale"),
        (MODEL_CARD.replace("scale: 1.0", "scale: 1.0, std: [1, 0, 1]"), "std must be positive"),
        (MODEL_CARD.replace("kind: inverse_depth", "kind: metric_depth"), "unit_m"),
        (MODEL_CARD.replace("kind: inverse_depth", "kind: distance"), "output.kind"),
        (MODEL_CARD.replace("side: 32", "side: 100000"), "side"),
        (MODEL_CARD + "sha256: short\n", "sha256"),
        ("- a list\n", "expected a mapping"),
        ("name: [unclosed\n", "not valid YAML"),
    ],
)
def test_faulty_card_names_what_is_wrong(text: str, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=rf"(?s)net\.yaml.*{complaint}"):
        read_card(_card(tmp_path, text))


def test_unknown_network_without_card_says_what_to_write(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"no model card.*net\.yaml.*card: NAME.*midas_small"):
        find_card(tmp_path / "net.onnx", "0" * 64)


@pytest.mark.fault("another network under the name of a known one", "it is refused by its sha256")
def test_card_of_another_file_is_refused(tmp_path: Path) -> None:
    _card(tmp_path, MODEL_CARD + f"sha256: {'a' * 64}\n")
    with pytest.raises(ModelError, match=f"sha256 {'b' * 64}, but its card tiny is for {'a' * 64}"):
        find_card(tmp_path / "net.onnx", "b" * 64)


@pytest.mark.parametrize(
    ("fit", "size", "expected"),
    [
        # Worked by hand after MiDaS' Resize: 512 / 376 = 1.36 is nearer to 1 than 512 / 1408 = 0.36.
        ("minimal", (376, 1408), (512, 1920)),
        ("minimal", (1400, 1400), (512, 512)),
        ("short", (376, 1408), (512, 1920)),
        ("long", (376, 1408), (128, 512)),
        ("minimal", (1080, 1920), (512, 896)),
        ("long", (1, 4000), (32, 512)),
    ],
)
def test_keep_aspect(fit: str, size: tuple[int, int], expected: tuple[int, int]) -> None:
    rule = KeepAspect.model_validate({"side": 512, "multiple": 32, "fit": fit})
    assert rule.size_for(*size) == expected


def test_fixed_size_ignores_the_image() -> None:
    assert FixedSize(height=192, width=640).size_for(1400, 1400) == (192, 640)
