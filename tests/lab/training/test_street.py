"""The network that comes with the package: it is there, it is known, and it orders what it never saw by distance."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("embreex", reason="needs embreex")

from coec.calibration.types import CameraFrame, DepthModel, EncodedImage, ImageFormat
from coec.config import DepthConfig, LimitsConfig
from coec.io.depth.depth_maps import open_depth
from coec.io.depth.model_cards import CARDS, find_card
from coec.io.depth.onnx_network import file_identity
from coec.io.images import encode_jpeg
from coec_lab.experiments.depth_quality import spearman
from coec_lab.simulation.drive import DriveConfig, SimulatedDrive
from coec_lab.training import training_scenes

STREET = CARDS / "street.onnx"
MOST_BYTES = 2_000_000
UNSEEN = 900_100
"""A seed that was not trained on."""
FARTHEST_M = 80.0
"""As `ObjectiveConfig.max_range_m`."""


@pytest.fixture(scope="module")
def street() -> DepthModel:
    return open_depth(DepthConfig(model="street", threads=1), LimitsConfig())


def test_it_is_small_and_its_card_knows_its_file_and_its_errors() -> None:
    assert STREET.stat().st_size < MOST_BYTES
    card = find_card(STREET, file_identity(STREET)[0])
    assert card.name == "street"
    assert card.sha256 is not None
    assert card.rank_correlation.keys() >= {"simulated_fisheye", "simulated_pinhole", "kitti360_image_00"}


def test_it_is_the_default() -> None:
    assert DepthConfig().model == "street"


def test_a_network_of_that_name_in_the_users_folder_comes_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    folder = tmp_path / "coec" / "models"
    folder.mkdir(parents=True)
    (folder / "street.onnx").write_bytes(STREET.read_bytes())
    (folder / "street.yaml").write_text("card: tcmonodepth_small_192x320\n")
    with pytest.raises(Exception, match="tcmonodepth_small_192x320"):
        open_depth(DepthConfig(model="street"), LimitsConfig())


def test_it_orders_unseen_rendered_frames_by_range(street: DepthModel) -> None:
    correlations = []
    for shown in training_scenes.frames(UNSEEN):
        height, width = shown.code.shape
        image = EncodedImage(ImageFormat.JPEG, width, height, encode_jpeg(shown.bgr, 95))
        values = street.infer(CameraFrame(0, "camera", image)).values
        rows = (np.arange(height) * values.shape[0]) // height
        columns = (np.arange(width) * values.shape[1]) // width
        near_enough = shown.code > 65535 / FARTHEST_M
        value = values[rows[:, None], columns[None, :]][near_enough].astype(np.float64)
        correlations.append(spearman(value, shown.code[near_enough].astype(np.float64)))
    assert np.median(correlations) > 0.85


def test_it_gives_the_same_bytes_again(street: DepthModel) -> None:
    drive = SimulatedDrive(DriveConfig(seed=3, seconds=0.1, camera="fisheye256"))
    (frame,) = (message for message in drive.messages() if isinstance(message, CameraFrame))
    assert street.infer(frame).values.tobytes() == street.infer(frame).values.tobytes()
