"""The depth network adapter, on networks of one operator and on the sample networks."""

import hashlib
import logging
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, EncodedImage, ImageFormat
from coec.config import LimitsConfig
from coec.errors import DecodeError, ModelError
from coec.io.depth.model_cards import CardInput, FixedSize, find_card
from coec.io.depth.onnx_network import OnnxDepth, Provider, file_identity, to_tensor
from coec.io.images import encode_png, probe
from support.recordings import DOUBLE, MODEL_CARD, first_channel_network

LIMITS = LimitsConfig()


def _frame(bgr: NDArray[np.uint8]) -> CameraFrame:
    return CameraFrame(0, "camera", probe(encode_png(bgr), LIMITS))


def _open(
    folder: Path, network: bytes, card: str = MODEL_CARD, providers: tuple[Provider, ...] = ("cpu",)
) -> OnnxDepth:
    path = folder / "net.onnx"
    path.write_bytes(network)
    path.with_suffix(".yaml").write_text(card)
    own, identity = file_identity(path)
    return OnnxDepth(path, find_card(path, own), providers, 1, LIMITS, identity)


def _noise(height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize(("order", "channel"), [("rgb", 2), ("bgr", 0)])
def test_pixels_are_fed_as_the_card_says(order: str, channel: int, tmp_path: Path) -> None:
    card = MODEL_CARD.replace("scale: 1.0", f"scale: 0.5, mean: [3, 5, 7], std: [2, 4, 8], colour_order: {order}")
    image = _noise(32, 48)  # already the size that the card asks for
    depth = _open(tmp_path, first_channel_network(), card).infer(_frame(image)).values
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, (image[:, :, channel] * 0.5 - 3) / 2, rtol=1e-6)


def test_tensor_channels_are_in_the_order_of_mean_and_std() -> None:
    size = FixedSize(height=16, width=16)
    card = CardInput(size=size, scale=1 / 255, mean=(0.485, 0.456, 0.406), std=(0.229, 0.224, 0.225))
    image = _noise(16, 16)
    tensor = to_tensor(image, card, 16, 16)
    assert tensor.shape == (1, 3, 16, 16)
    red_green_blue = image[:, :, ::-1] / 255.0
    expected = (red_green_blue - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
    np.testing.assert_allclose(tensor[0].transpose(1, 2, 0), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("interpolation", "size", "expected"),
    [
        ("area", (16, 16), cv2.INTER_AREA),
        ("area", (80, 80), cv2.INTER_LINEAR),
        ("area", (16, 80), cv2.INTER_LINEAR),
        ("linear", (16, 16), cv2.INTER_LINEAR),
        ("cubic", (16, 80), cv2.INTER_CUBIC),
    ],
)
def test_interpolation(interpolation: str, size: tuple[int, int], expected: int) -> None:
    card = CardInput.model_validate(
        {"size": {"height": 16, "width": 16}, "scale": 1, "interpolation": interpolation, "colour_order": "bgr"}
    )
    image = _noise(40, 40)
    resized = cv2.resize(image, size[::-1], interpolation=expected).astype(np.float32)
    np.testing.assert_array_equal(to_tensor(image, card, *size)[0].transpose(1, 2, 0), resized)


def test_size_follows_each_image_where_the_network_is_free(tmp_path: Path) -> None:
    model = _open(tmp_path, first_channel_network())
    assert model.infer(_frame(_noise(64, 192))).values.shape == (32, 96)
    assert model.infer(_frame(_noise(100, 100))).values.shape == (32, 32)


def test_fixed_network_decides_its_size_where_the_card_only_keeps_the_aspect(tmp_path: Path) -> None:
    model = _open(tmp_path, first_channel_network((1, 3, 48, 64)))
    assert model.infer(_frame(_noise(20, 200))).values.shape == (48, 64)


def test_same_image_gives_same_bytes(tmp_path: Path) -> None:
    frame = _frame(_noise(50, 70))
    first, second = (_open(tmp_path, first_channel_network(), MODEL_CARD).infer(frame).values for _ in range(2))
    assert first.tobytes() == second.tobytes()


def test_values_that_are_not_finite_become_nan(tmp_path: Path) -> None:
    image = np.zeros((32, 32, 3), dtype=np.uint8)
    image[:16] = 200
    depth = _open(tmp_path, first_channel_network(then="Reciprocal")).infer(_frame(image)).values
    np.testing.assert_allclose(depth[:16], 1 / 200)
    assert np.isnan(depth[16:]).all()


def test_constant_map_is_allowed(tmp_path: Path) -> None:
    depth = _open(tmp_path, first_channel_network()).infer(_frame(np.full((32, 32, 3), 9, np.uint8))).values
    np.testing.assert_array_equal(depth, 9)


def test_identity_is_the_sha256_of_the_file(tmp_path: Path) -> None:
    network = first_channel_network()
    assert _open(tmp_path, network).identity == hashlib.sha256(network).hexdigest()


def test_external_weights_are_loaded_and_belong_to_the_identity(tmp_path: Path) -> None:
    network = first_channel_network(weights_file="net.onnx.data")
    (tmp_path / "net.onnx.data").write_bytes(bytes(8))
    frame = _frame(np.full((32, 32, 3), (10, 20, 30), np.uint8))
    red = _open(tmp_path, network)
    assert red.infer(frame).values.max() == 30
    (tmp_path / "net.onnx.data").write_bytes(bytes([1, 0, 0, 0, 0, 0, 0, 0]))
    green = _open(tmp_path, network)
    assert green.infer(frame).values.max() == 20
    assert red.identity != green.identity


@pytest.mark.parametrize(
    ("network", "complaint"),
    [
        (b"", "cannot be loaded"),
        (b"<html>not found</html>", "cannot be loaded"),
        (first_channel_network()[:-40], "cannot be loaded"),
        (first_channel_network(weights_file="net.onnx.data"), "external weights missing"),
        (first_channel_network(input_name="pixels"), r"has the inputs pixels; its card \(tiny\) names 'image'"),
        (first_channel_network(output_name="range"), r"has the outputs range; its card \(tiny\) names 'depth'"),
        (first_channel_network(element=DOUBLE), r"tensor\(double\).*expected tensor\(float\)"),
        (first_channel_network((1, 4, "h", "w")), r"expected \[1, 3, height, width\]"),
        (first_channel_network((2, 3, 32, 32)), r"expected \[1, 3, height, width\]"),
        (first_channel_network((1, 3, 32)), r"expected \[1, 3, height, width\]"),
        (first_channel_network((1, 3, 40, 48)), "does not fit the size in its card tiny"),
        (first_channel_network(then="Shape"), "cannot be loaded"),
    ],
)
def test_unfit_network_is_an_error_at_the_start(network: bytes, complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=rf"(?s)net\.onnx.*{complaint}"):
        _open(tmp_path, network)


def test_fixed_size_of_card_and_network_must_agree(tmp_path: Path) -> None:
    card = MODEL_CARD.replace("side: 32, multiple: 16, fit: short", "height: 32, width: 64")
    _open(tmp_path, first_channel_network((1, 3, 32, 64)), card)
    with pytest.raises(ModelError, match="does not fit the size in its card"):
        _open(tmp_path, first_channel_network((1, 3, 64, 32)), card)


def test_network_without_any_finite_value_is_an_error_at_the_start(tmp_path: Path) -> None:
    card = MODEL_CARD.replace("scale: 1.0", "scale: 1.0, mean: [300, 300, 300]")  # root of negative numbers
    with pytest.raises(ModelError, match="no finite value for a test image"):
        _open(tmp_path, first_channel_network(then="Sqrt"), card)


def test_several_outputs_need_a_name(tmp_path: Path) -> None:
    network = first_channel_network(second_output=True)
    assert _open(tmp_path, network).infer(_frame(_noise(32, 32))).values.shape == (32, 32)
    with pytest.raises(ModelError, match=r"depth, copy; its card \(tiny\) names none"):
        _open(tmp_path, network, MODEL_CARD.replace("name: depth, ", ""))
    with pytest.raises(ModelError, match=r"'copy' has shape \[1, 3, 32, 32\], expected one map"):
        _open(tmp_path, network, MODEL_CARD.replace("name: depth", "name: copy"))


def test_missing_file_is_a_model_error(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"cannot read the depth network .*none\.onnx"):
        file_identity(tmp_path / "none.onnx")


def test_absent_provider_is_left_out_with_a_line_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
    with caplog.at_level(logging.WARNING):
        model = _open(tmp_path, first_channel_network(), providers=("cuda", "cpu", "tensorrt"))
    assert [record.getMessage() for record in caplog.records] == [
        "onnxruntime on this machine has no cuda: left out",
        "onnxruntime on this machine has no tensorrt: left out",
    ]
    assert model.infer(_frame(_noise(32, 32))).values.shape == (32, 32)


def test_broken_image_is_a_decode_error(tmp_path: Path) -> None:
    image = EncodedImage(ImageFormat.JPEG, 32, 32, b"\xff\xd8 no more")
    with pytest.raises(DecodeError):
        _open(tmp_path, first_channel_network()).infer(CameraFrame(0, "camera", image))


@pytest.mark.fault("an image of absurd aspect ratio, which makes the network's input huge", "it is refused")
def test_image_of_absurd_aspect_is_refused(tmp_path: Path) -> None:
    card = MODEL_CARD.replace("side: 32", "side: 512")
    with pytest.raises(DecodeError) as caught:
        _open(tmp_path, first_channel_network(), card).infer(_frame(np.zeros((2, 9000, 3), np.uint8)))
    assert caught.value.reason == "image_too_large"


@pytest.mark.parametrize(
    ("file", "shape"),
    [
        ("tcsmallnet_dyn.onnx", (256, 960)),
        ("tcmonodepth_tcsmallnet_192x320.onnx", (192, 320)),
        ("meter_xxs_kitti_192x640.onnx", (48, 160)),
    ],
)
def test_sample_networks_see_that_the_road_below_is_near(file: str, shape: tuple[int, int], sample_data: Path) -> None:
    path = sample_data / "depth" / file
    own, identity = file_identity(path)
    card = find_card(path, own)
    model = OnnxDepth(path, card, ("cpu",), 2, LIMITS, identity)
    images = sample_data / "kitti360/data_2d_raw/2013_05_28_drive_0000_sync/image_00/data_rect"
    for image in sorted(images.glob("*.png"))[:3]:
        depth = model.infer(CameraFrame(0, "camera", probe(image.read_bytes(), LIMITS))).values
        assert depth.shape == shape
        assert np.isfinite(depth).all()
        # The horizon of these images is at about half their height.
        below, middle = np.median(depth[-shape[0] // 8 :]), np.median(depth[shape[0] // 3 : shape[0] // 2])
        assert (below > 1.5 * middle) == (card.output.kind == "inverse_depth")
