"""`CameraInfo` to intrinsics: the image's own numbers, in the form in which the image comes, or a reason."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from coec.errors import DecodeError, SourceError
from coec.geometry import cameras
from coec.geometry.projection import project
from coec.io.rig_files import camera_of
from coec.io.ros.camera_info import (
    MAX_INFO_BYTES,
    CameraInfoContent,
    decode_info,
    info_topic,
    intrinsics_of_info,
    is_rectified,
)
from support.ros import Packer

K = (500.0, 0.0, 319.5, 0.0, 510.0, 239.5, 0.0, 0.0, 1.0)
P = (480.0, 0.0, 321.0, 0.0, 0.0, 481.0, 238.0, 0.0, 0.0, 0.0, 1.0, 0.0)
EYE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
RATIONAL = (0.5136, -2.6795, 0.000838, -0.000085, 1.5490, 0.3928, -2.5068, 1.4778)


def info(**changes: Any) -> CameraInfoContent:
    given: dict[str, Any] = {
        "frame_id": "optical",
        "size": (640, 480),
        "model": "plumb_bob",
        "d": (),
        "k": K,
        "r": EYE,
        "p": P,
        "binning": (1, 1),
        "roi": (0, 0, 0, 0),
    }
    return CameraInfoContent(**given | changes)


def packed(*, d: tuple[float, ...] = (), claimed: int | None = None, model: str = "plumb_bob", **of: Any) -> bytes:
    """A `CameraInfo` in CDR, by hand."""
    packer = Packer().header(of.get("frame_id", "optical")).put("I", 480, 640).text(model)
    packer.put("I", len(d) if claimed is None else claimed).put("d", *d, *K, *EYE, *P)
    return packer.put("I", *of.get("binning", (0, 0)), *of.get("roi", (0, 0, 0, 0))).put("?", False).done()


def camera(reported: CameraInfoContent, *, rectified: bool = False) -> cameras.Camera:
    return camera_of(intrinsics_of_info(reported, rectified=rectified).intrinsics)


def rays() -> NDArray[np.float64]:
    rng = np.random.default_rng(3)
    return np.column_stack([rng.uniform(-0.5, 0.5, (200, 2)), np.ones(200)]) * rng.uniform(1.0, 30.0, (200, 1))


def by_opencv(reported: CameraInfoContent, points: NDArray[np.float64]) -> NDArray[np.float64]:
    matrix, zero = np.reshape(reported.k, (3, 3)), np.zeros(3)
    return np.asarray(cv2.projectPoints(points[:, None], zero, zero, matrix, np.array(reported.d))[0][:, 0])


def test_a_message_is_read_as_it_was_packed() -> None:
    result = decode_info(packed(d=RATIONAL, model="rational_polynomial", binning=(2, 1), roi=(1, 2, 30, 20)))
    # regions of interest are packed as x, y, height, width
    assert result == info(model="rational_polynomial", d=RATIONAL, binning=(2, 1), roi=(1, 2, 20, 30))


@pytest.mark.parametrize(
    ("model", "d", "name"),
    [
        ("plumb_bob", (), "pinhole"),
        ("", (), "pinhole"),
        ("none", (0.0,) * 5, "pinhole"),
        ("plumb_bob", (-0.3, 0.1, 1e-3, -2e-3), "radtan"),
        ("plumb_bob", (-0.3, 0.1, 1e-3, -2e-3, 0.02), "radtan"),
        ("rational_polynomial", (-0.3, 0.1, 1e-3, -2e-3, 0.02, 0.0, 0.0, 0.0), "radtan"),
        ("rational_polynomial", RATIONAL, "rational"),
        ("rational_polynomial", (*RATIONAL, *(0.0,) * 6), "rational"),
        ("plumb_bob", RATIONAL, "rational"),
    ],
)
def test_polynomials_project_as_opencv_does(model: str, d: tuple[float, ...], name: str) -> None:
    reported = info(model=model, d=d)
    assert intrinsics_of_info(reported, rectified=False).intrinsics.model == name
    uv_px, valid = project(camera(reported), rays())
    assert valid.all()
    np.testing.assert_allclose(uv_px, by_opencv(reported, rays()), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("model", "d", "name", "parameters"),
    [
        ("equidistant", (0.1, 0.2, 0.3, 0.4), "kannala_brandt", {"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}),
        ("fisheye", (0.0,) * 4, "kannala_brandt", {"k1": 0.0, "k2": 0.0, "k3": 0.0, "k4": 0.0}),
        ("double_sphere", (-0.2, 0.6), "double_sphere", {"xi": -0.2, "alpha": 0.6}),
        ("ds", (-0.2, 0.6, 0.0), "double_sphere", {"xi": -0.2, "alpha": 0.6}),
        ("eucm", (0.6, 1.1), "eucm", {"alpha": 0.6, "beta": 1.1}),
        ("mei", (2.2, 0.1, 0.2, 1e-3, 2e-3), "mei", {"xi": 2.2, "k1": 0.1, "k2": 0.2, "p1": 1e-3, "p2": 2e-3}),
        ("cata", (1.0, 0.0, 0.0, 0.0, 0.0), "mei", {"xi": 1.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0}),
    ],
)
def test_other_lenses_by_their_names(model: str, d: tuple[float, ...], name: str, parameters: dict[str, float]) -> None:
    size = {"width": 640, "height": 480, "fx": 500.0, "fy": 510.0, "cx": 319.5, "cy": 239.5}
    assert camera(info(model=model, d=d)) == cameras.build(name, **size, **parameters)


def test_a_rectified_image_has_no_distortion_whatever_the_lens() -> None:
    reported = info(model="equidistant", d=(0.1, 0.2, 0.3, 0.4))
    expected = cameras.build("pinhole", width=640, height=480, fx=480.0, fy=481.0, cx=321.0, cy=238.0)
    assert camera(reported, rectified=True) == expected
    assert "rectified" in intrinsics_of_info(reported, rectified=True).source


def test_a_region_is_cut_out_and_then_binned() -> None:
    """A point's pixel of the whole image, less the region's corner, falls into the square of pixels that were added."""
    whole, part = info(d=RATIONAL), info(d=RATIONAL, roi=(100, 40, 400, 300), binning=(2, 4))
    of_part = camera(part)
    assert (of_part.width, of_part.height) == (200, 75)
    pixels_px, _ = project(camera(whole), rays())
    expected_px = (pixels_px - [100.0, 40.0] + 0.5) / [2.0, 4.0] - 0.5
    np.testing.assert_allclose(project(of_part, rays())[0], expected_px, rtol=0, atol=1e-9)


def test_a_turn_that_is_not_applied_is_reported() -> None:
    turned = cv2.Rodrigues(np.radians([0.0, 1.0, 0.0]))[0].reshape(-1).tolist()
    assert "1.00 deg" in intrinsics_of_info(info(r=tuple(turned)), rectified=False).source
    assert "deg" not in intrinsics_of_info(info(), rectified=False).source
    assert "deg" not in intrinsics_of_info(info(r=(0.0,) * 9), rectified=False).source


@pytest.mark.parametrize(
    ("changes", "rectified", "complaint"),
    [
        ({"k": (0.0,) * 9}, False, "uncalibrated"),
        ({"p": (0.0,) * 12}, True, "uncalibrated for rectified"),
        ({"d": (float("nan"),) * 5}, False, "not finite"),
        ({"k": (float("inf"), *K[1:])}, False, "not finite"),
        ({"k": (-500.0, *K[1:])}, False, "fx must be above zero"),
        ({"k": (500.0, 3.0, *K[2:])}, False, "skew"),
        ({"size": (0, 480)}, False, "width"),
        ({"size": (100_000, 480)}, False, "width"),
        ({"d": (0.1, 0.2)}, False, "four or five"),
        ({"d": (*RATIONAL, 0.1, 0.0, 0.0, 0.0)}, False, "thin prisms"),
        ({"model": "equidistant", "d": (0.1, 0.2, 0.3)}, False, "k1 k2 k3 k4; here are 3"),
        ({"model": "ds", "d": (0.1, 7.0)}, False, "alpha must lie in"),
        ({"model": "oblique", "d": (0.1,) * 4}, False, "of this name is not known"),
        ({"p": (*P[:3], -57.6, *P[4:])}, True, "second image, 0.120 m beside"),
        ({"roi": (400, 0, 300, 480)}, False, "beyond the image"),
    ],
)
def test_what_is_no_calibration_is_refused_by_name(changes: dict[str, Any], rectified: bool, complaint: str) -> None:
    with pytest.raises(SourceError, match=complaint):
        intrinsics_of_info(info(**changes), rectified=rectified)


@pytest.mark.fault("a CameraInfo with a million coefficients, cut off or of strange names", "refused with a cause")
@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x00\x01\x00\x00",
        packed()[:-9],
        packed(claimed=1_000_000),
        packed(claimed=2**32 - 1),
        packed(d=(0.0,) * 100),
        packed(d=(0.0,) * (MAX_INFO_BYTES // 8)),
        packed(frame_id="x" * 200),
        packed(model="x" * 200),
    ],
)
def test_hostile_messages_are_refused_with_a_cause(payload: bytes) -> None:
    with pytest.raises(DecodeError):
        decode_info(payload)


@pytest.mark.parametrize(
    ("image", "expected"),
    [
        ("/front/image_raw", "/front/camera_info"),
        ("/sensing/camera/front/image_raw/compressed", "/sensing/camera/front/camera_info"),
        ("/front/image_rect_color/ffmpeg", "/front/camera_info"),
        ("/image", "/camera_info"),
        ("/compressed", "/camera_info"),
    ],
)
def test_the_info_lies_next_to_the_image(image: str, expected: str) -> None:
    assert info_topic(image) == expected


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("/front/image_rect", True),
        ("/front/image_rect_color/compressed", True),
        ("/rectified/image", True),
        ("/front/image_raw", False),
        ("/front/direct/image", False),
    ],
)
def test_rectified_images_are_known_by_their_topic(topic: str, expected: bool) -> None:
    assert is_rectified(topic) is expected
