"""The network `street`: a U-Net of depthwise separable convolutions (Ronneberger et al., MICCAI 2015; Howard et al.,
MobileNets, 2017; blocks in the order of Liu et al., ConvNeXt, CVPR 2022), 0.9 million parameters.

It is fully convolutional: height and width may be any multiples of 32. `export` makes the shipped ONNX file
from a checkpoint.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import fusion

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


OPSET = 17
INPUT, OUTPUT = "image", "inverse_depth"
SMALL = 64
"""Weights with fewer values than this stay float32."""


def export(checkpoint: Path, path: Path) -> None:
    """Writes the averaged network with free height and width; large weights are float16, which halves the file.

    Arithmetic stays float32: onnxruntime casts the weights once, when it loads them.
    """
    network = StreetNet()
    network.load_state_dict(torch.load(checkpoint, weights_only=True)["average"])
    network.eval()
    _fuse(network)
    free = {2: "height", 3: "width"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package is called legacy
        torch.onnx.export(
            network, (torch.zeros(1, 3, 192, 256),), str(path), input_names=[INPUT], output_names=[OUTPUT],
            dynamic_axes={INPUT: free, OUTPUT: free},
            opset_version=OPSET, dynamo=False,
        )  # fmt: skip
    model = onnx.load(str(path))
    _halve_weights(model.graph)
    onnx.checker.check_model(model)
    onnx.save(model, str(path))


def _fuse(network: nn.Module) -> None:
    """Folds each batch normalisation into the convolution directly before it; that is safe, as each is used once."""
    for module in network.modules():
        if isinstance(module, nn.Sequential):
            for index in range(len(module) - 1):
                first, second = module[index], module[index + 1]
                if isinstance(first, nn.Conv2d) and isinstance(second, nn.BatchNorm2d):
                    module[index] = fusion.fuse_conv_bn_eval(first, second)
                    module[index + 1] = nn.Identity()


def _halve_weights(graph: onnx.GraphProto) -> None:
    casts = []
    for tensor in list(graph.initializer):
        values = numpy_helper.to_array(tensor)
        if values.dtype != np.float32 or values.size < SMALL:
            continue
        name = tensor.name
        graph.initializer.remove(tensor)
        graph.initializer.append(numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
        casts.append(helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    for cast in reversed(casts):
        graph.node.insert(0, cast)


def same(checkpoint: Path, path: Path, image: Tensor) -> float:
    """Largest difference between checkpoint and ONNX file on an image (1, 3, H, W), over the spread of the output."""
    import onnxruntime

    network = StreetNet()
    network.load_state_dict(torch.load(checkpoint, weights_only=True)["average"])
    network.eval()
    with torch.no_grad():
        expected = network(image).numpy()
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    got = session.run([OUTPUT], {INPUT: image.numpy()})[0]
    return float(np.abs(got - expected).max() / np.ptp(expected))
