"""Trains the network on a folder of frames."""

from __future__ import annotations

import copy
import logging
import time
from pathlib import Path

import numpy as np
import torch

from coec.simulation.training import files
from coec.simulation.training.augment import augment
from coec.simulation.training.loss import loss
from coec.simulation.training.network import StreetNet
from coec.simulation.training.shown import SHAPES, TrainingFrame

logger = logging.getLogger(__name__)

BATCH = 8
RATE, WARM_STEPS, FALL_SHARE = 1.5e-3, 100, 0.35
"""Learning rate of AdamW: rises over `WARM_STEPS`, stays, and falls to 0 over the last `FALL_SHARE` of steps."""
DECAY = 0.02
AVERAGE = 0.995
"""Share of the averaged weights that is kept at each step (Polyak)."""
CLIP = 1.0
"""Largest norm of a gradient."""
SIZE_FACTORS = (0.84, 1.0, 1.2)
"""Factors on the sizes in `SHAPES`, drawn for each batch; the sizes are rounded to multiples of 32."""
SHARES = {"round": 0.3, "wide": 0.3, "panorama": 0.4}
"""How often each kind is shown; strips most often, because they are the hardest."""
SAVE_STEPS = 100


class Shelf:
    """The frames of a folder by kind; `refresh` reads new files."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: set[Path] = set()
        self.frames: dict[str, list[TrainingFrame]] = {kind: [] for kind in SHAPES}

    def refresh(self) -> int:
        """Reads the files that have come since the last call; returns the number of all frames."""
        for path in files.towns(self._folder):
            if path not in self._read:
                self._read.add(path)
                for frame in files.read(path):
                    self.frames[frame.kind].append(frame)
        return sum(len(frames) for frames in self.frames.values())

    def batch(self, rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
        """A random batch: RGB (B, 3, H, W) and target (B, H, W)."""
        kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        scale = rng.choice(SIZE_FACTORS)
        height, width = (max(32, 32 * round(scale * side / 32)) for side in SHAPES[kind])
        shown = self.frames[kind]
        pairs = [augment(shown[int(rng.integers(len(shown)))], height, width, rng) for _ in range(BATCH)]
        rgb = torch.from_numpy(np.stack([rgb for rgb, _ in pairs]).transpose(0, 3, 1, 2).copy())
        return rgb.contiguous(memory_format=torch.channels_last), torch.from_numpy(np.stack([t for _, t in pairs]))


def train(folder: Path, checkpoint: Path, steps: int, seed: int, threads: int) -> None:
    """Trains up to step `steps`, going on from the checkpoint if there is one. Checkpoints also hold averaged weights.

    The same folder, seed and steps give the same draws; the weights also depend on the processor.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    network = StreetNet().to(memory_format=torch.channels_last)
    average = copy.deepcopy(network)
    optimiser = torch.optim.AdamW(network.parameters(), lr=RATE, weight_decay=DECAY)
    begin = 0
    if checkpoint.is_file():
        saved = torch.load(checkpoint, weights_only=True)
        network.load_state_dict(saved["network"])
        average.load_state_dict(saved["average"])
        optimiser.load_state_dict(saved["optimiser"])
        begin = saved["step"]
    shelf = Shelf(folder)
    network.train()
    losses: list[float] = []
    since = time.perf_counter()
    for step in range(begin, steps):
        if step % SAVE_STEPS == 0 or step == begin:
            count = shelf.refresh()
        rng = np.random.default_rng([seed, step])
        for group in optimiser.param_groups:
            group["lr"] = rate(step, steps)
        rgb, target = shelf.batch(rng)
        output = network(rgb)
        blame = loss(output[:, 0], target, torch.Generator().manual_seed(seed + step))
        optimiser.zero_grad()
        blame.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), CLIP)
        optimiser.step()
        _follow(average, network, min(AVERAGE, (1 + step) / (10 + step)))
        losses.append(float(blame.detach()))
        if (step + 1) % SAVE_STEPS == 0 or step + 1 == steps:
            lasted_s = time.perf_counter() - since
            logger.info(
                "step %d of %d, %d frames, loss %.4f, %.0f s", step + 1, steps, count, np.mean(losses), lasted_s
            )
            losses, since = [], time.perf_counter()
            _save(checkpoint, step + 1, network, average, optimiser)


def rate(step: int, steps: int) -> float:
    """Learning rate of a step."""
    rise = min(1.0, (step + 1) / WARM_STEPS)
    left = (steps - step) / (FALL_SHARE * steps)
    return RATE * rise * min(1.0, left)


@torch.no_grad()
def _follow(average: StreetNet, network: StreetNet, share: float) -> None:
    for name, value in network.state_dict().items():
        mean = average.state_dict()[name]
        if value.dtype.is_floating_point:
            mean.lerp_(value, 1 - share)
        else:
            mean.copy_(value)


def _save(path: Path, step: int, network: StreetNet, average: StreetNet, optimiser: torch.optim.Optimizer) -> None:
    part = path.with_suffix(".part")
    state = {"step": step, "network": network.state_dict(), "average": average.state_dict()}
    torch.save(state | {"optimiser": optimiser.state_dict()}, part)
    part.rename(path)
