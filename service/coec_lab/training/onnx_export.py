"""Makes the shipped ONNX file from a checkpoint."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper
from torch import Tensor, nn
from torch.nn.utils import fusion

from coec_lab.training.network import StreetNet

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
