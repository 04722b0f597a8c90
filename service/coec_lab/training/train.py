"""Trains the depth network: batches of frames that are changed each time they are shown, the loss, the optimiser,
checkpoints.
"""

from __future__ import annotations

import copy
import logging
import time
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from coec_lab.training import training_frames
from coec_lab.training.network import StreetNet
from coec_lab.training.training_frames import SHAPES, TrainingFrame, augment

GRADIENT_WEIGHT, RANK_WEIGHT = 0.5, 0.5
GRADIENT_SCALES = 4
"""Scales of the gradient term, each half the size of the one before."""
PAIRS = 4096
"""Random pairs of pixels per picture whose order is compared; half of them are neighbours."""
REACH_PX = 16
"""Greatest distance of neighbours along rows and columns, so that a car must stand out from the road behind it."""
LEAST_SPREAD = 0.02
"""Least spread of a target, 1/√m, so that the normalisation does not magnify a flat wall."""
SAME = 0.03
"""Pairs whose targets differ by less than this share of the larger have no order."""


def loss(output: Tensor, target: Tensor, generator: torch.Generator) -> Tensor:
    """Mean distance from the normalised target and its gradients (Ranftl et al., TPAMI 2022, equations (5), (7), (11)),
    and a ranking term (Chen et al., NIPS 2016).

    Only the target is normalised: then no picture's scale has to be known, and a flat output still has no steep slope.

    Args:
        output: (B, H, W), any scale and shift.
        target: (B, H, W), NaN where unknown.
    """
    known = torch.isfinite(target)
    known_target = torch.where(known, target, torch.zeros_like(target))
    a, b = output, _normalised(known_target, known)
    residual = torch.where(known, a - b, torch.zeros_like(a))
    shape = residual.abs().sum() / known.sum().clamp(min=1)
    return (
        shape + GRADIENT_WEIGHT * _gradients(residual, known) + RANK_WEIGHT * _order(a, known_target, known, generator)
    )


def _normalised(x: Tensor, known: Tensor) -> Tensor:
    """x minus its median, over its mean distance from the median, both over the known pixels of each picture."""
    flat, mask = x.flatten(1), known.flatten(1)
    count = mask.sum(1, keepdim=True).clamp(min=1)
    holes = torch.where(mask, flat, torch.full_like(flat, float("nan")))
    middle = torch.nan_to_num(holes.nanmedian(1, keepdim=True).values)
    distance = torch.where(mask, (flat - middle).abs(), torch.zeros_like(flat))
    spread = (distance.sum(1, keepdim=True) / count).clamp(min=LEAST_SPREAD)
    return ((flat - middle) / spread).view_as(x)


def _gradients(residual: Tensor, known: Tensor) -> Tensor:
    total = residual.new_zeros(())
    for scale in range(GRADIENT_SCALES):
        step = 2**scale
        a, m = residual[:, ::step, ::step], known[:, ::step, ::step]
        for dim in (1, 2):
            n = a.shape[dim] - 1
            both = m.narrow(dim, 0, n) & m.narrow(dim, 1, n)
            change = (a.narrow(dim, 1, n) - a.narrow(dim, 0, n)).abs()
            total = total + (change * both).sum() / both.sum().clamp(min=1)
    return total / GRADIENT_SCALES


def _order(output: Tensor, target: Tensor, known: Tensor, generator: torch.Generator) -> Tensor:
    flat, goal, mask = output.flatten(1), target.flatten(1), known.flatten(1)
    first, second = torch.randint(flat.shape[1], (2, PAIRS), generator=generator)
    down, right = torch.randint(-REACH_PX, REACH_PX + 1, (2, PAIRS // 2), generator=generator)
    second[: PAIRS // 2] = (first[: PAIRS // 2] + down * output.shape[2] + right) % flat.shape[1]
    difference = goal[:, first] - goal[:, second]
    larger = torch.maximum(goal[:, first], goal[:, second])
    ordered = mask[:, first] & mask[:, second] & (difference.abs() > SAME * larger)
    # Scaled so that the term stops pulling once a pair is well apart.
    wrong = functional.softplus(-4.0 * difference.sign() * (flat[:, first] - flat[:, second]))
    return (wrong * ordered).sum() / ordered.sum().clamp(min=1)


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
        for path in training_frames.towns(self._folder):
            if path not in self._read:
                self._read.add(path)
                for frame in training_frames.read(path):
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
