"""The training loss: it punishes wrong shape, wrong edges, and wrong order."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

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
