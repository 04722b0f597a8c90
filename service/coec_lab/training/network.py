"""The network `street`: a U-Net of depthwise separable convolutions (Ronneberger et al., MICCAI 2015; Howard et al.,
MobileNets, 2017; blocks in the order of Liu et al., ConvNeXt, CVPR 2022), 0.9 million parameters.

It is fully convolutional: height and width may be any multiples of 32.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

WIDTHS = (16, 32, 48, 96, 160)
"""Channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the size."""
DEPTHS = (0, 1, 2, 3, 3)
"""Blocks at each of these sizes."""
UP = (16, 24, 32, 64)
"""Channels of the way back at 1/2, 1/4, 1/8 and 1/16."""
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and deviation of RGB / 255, as is usual since ImageNet: part of the network, which takes RGB 0 to 255."""


class Block(nn.Module):
    """A 5×5 depthwise convolution, then two 1×1 with twice the channels between them, added to the input."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 5, padding=2, groups=channels, bias=False),
            nn.BatchNorm2d(channels),
            nn.Conv2d(channels, 2 * channels, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(2 * channels, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) to the same shape."""
        return x + self.body(x)


class Context(nn.Module):
    """Adds a function of the mean over the whole picture to each place."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.body = nn.Sequential(
            nn.Conv2d(channels, channels, 1), nn.ReLU(inplace=True), nn.Conv2d(channels, channels, 1)
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) to the same shape."""
        return x + self.body(x.mean(dim=(2, 3), keepdim=True))


class StreetNet(nn.Module):
    """RGB 0 to 255, (B, 3, H, W), to √(inverse range) up to scale and shift, (B, 1, H, W)."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", 255 * torch.tensor(MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", 255 * torch.tensor(STD).view(1, 3, 1, 1), persistent=False)
        stages = []
        before = 3
        for channels, count in zip(WIDTHS, DEPTHS, strict=True):
            halve = nn.Conv2d(before, channels, 3, stride=2, padding=1, bias=False)
            stages.append(
                nn.Sequential(
                    halve, nn.BatchNorm2d(channels), nn.ReLU(inplace=True), *(Block(channels) for _ in range(count))
                )
            )
            before = channels
        self.down = nn.ModuleList(stages)
        self.context = Context(WIDTHS[-1])
        self.across = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip(WIDTHS[:-1], UP, strict=True))
        self.below = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in zip((*UP[1:], WIDTHS[-1]), UP, strict=True))
        # No blocks at 1/2, which would take half of the time.
        self.up = nn.ModuleList([nn.Identity(), *(Block(channels) for channels in UP[1:])])
        self.head = nn.Sequential(nn.Conv2d(UP[0], UP[0], 3, padding=1), nn.ReLU(inplace=True), nn.Conv2d(UP[0], 1, 1))

    def forward(self, rgb: Tensor) -> Tensor:
        """See the class."""
        x = (rgb - self.mean) / self.std
        skips = []
        for stage in self.down:
            x = stage(x)
            skips.append(x)
        x = self.context(skips.pop())
        for level in reversed(range(len(UP))):
            x = self.below[level](x)
            x = functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)
            x = self.up[level](functional.relu(x + self.across[level](skips[level])))
        return functional.interpolate(self.head(x), scale_factor=2.0, mode="bilinear", align_corners=False)
