"""The network can be trained, resumed and exported; skipped where torch is not installed."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="needs the extra `train` of coec-lab")
pytest.importorskip("onnx", reason="needs the extra `train` of coec-lab")

import torch

from coec_lab.training import training_frames
from coec_lab.training.network import StreetNet, export, same
from coec_lab.training.train import RATE, WARM_STEPS, loss, rate, train
from coec_lab.training.training_frames import SHAPES, TrainingFrame


def _ramps() -> list[TrainingFrame]:
    """Brighter is nearer: what a network learns in a few steps."""
    frames = []
    for kind, (height, width) in SHAPES.items():
        code = np.linspace(600, 20000, width, dtype=np.uint16)[None, :].repeat(height, axis=0)
        bgr = np.linspace(20, 240, width).astype(np.uint8)[None, :, None].repeat(height, axis=0).repeat(3, axis=2)
        frames.append(TrainingFrame(kind, bgr, code))
    return frames


def _target() -> torch.Tensor:
    target = torch.linspace(0.1, 0.9, 64).repeat(2, 32, 1)
    target[0, :4] = float("nan")
    return target


def _blame(output: torch.Tensor) -> float:
    return float(loss(output, _target(), torch.Generator().manual_seed(0)))


def test_loss_prefers_the_right_order_and_ignores_what_is_unknown() -> None:
    right = (_target().nan_to_num() - 0.5) * 5
    assert _blame(right) < _blame(torch.zeros_like(right)) < _blame(-right)
    elsewhere = right.clone()
    elsewhere[0, :4] = 7.0
    assert _blame(elsewhere) == pytest.approx(_blame(right), rel=1e-6)


def test_loss_does_not_know_the_scale_of_the_target() -> None:
    output = torch.randn(2, 32, 64, generator=torch.Generator().manual_seed(1))
    far = loss(output, 0.3 * _target(), torch.Generator().manual_seed(0))
    assert float(far) == pytest.approx(_blame(output), rel=1e-4)


def test_network_takes_any_multiple_of_32() -> None:
    network = StreetNet().eval()
    with torch.no_grad():
        for height, width in ((32, 32), (96, 160)):
            assert network(torch.zeros(1, 3, height, width)).shape == (1, 1, height, width)


def test_learning_rate_rises_stays_and_falls() -> None:
    rates = [rate(step, 2000) for step in range(2000)]
    assert rates[0] == pytest.approx(RATE / WARM_STEPS)
    assert rates[600] == RATE
    assert 0 < rates[-1] < 0.01 * RATE


def test_training_learns_goes_on_and_exports_what_it_learned(tmp_path: Path) -> None:
    training_frames.write(tmp_path, 1, _ramps())
    checkpoint, network = tmp_path / "net.pt", tmp_path / "net.onnx"
    train(tmp_path, checkpoint, 2, 0, 1)
    train(tmp_path, checkpoint, 4, 0, 1)
    assert torch.load(checkpoint, weights_only=True)["step"] == 4
    export(checkpoint, network)
    assert network.stat().st_size < 2_000_000
    image = 255 * torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(2))
    assert same(checkpoint, network, image) < 0.02
