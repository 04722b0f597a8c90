"""A monocular depth network in an ONNX file, run by onnxruntime: the virtual depth sensor of the method."""

import hashlib
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from coec.calibration.types import CameraFrame, DepthMap
from coec.config import LimitsConfig
from coec.errors import DecodeError, ModelError, cannot_read
from coec.io.depth.model_cards import CardInput, FixedSize, ModelCard
from coec.io.frame_validation import Refusal
from coec.io.images import decode_bgr

logger = logging.getLogger(__name__)

Provider = Literal["cpu", "cuda", "tensorrt"]

PROVIDERS: dict[Provider, str] = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}

MAX_INPUT_PIXELS = 2**22
"""Largest network input, px: four times that of dpt_beit_large_512 on KITTI-360's 1408×376. Larger ones are refused,
which bounds the memory that an image of absurd aspect ratio can take."""

TEST_IMAGE_SIZE = (512, 512)
"""Height and width, px, of the image that stands in for a camera's when a network is opened."""

_INTERPOLATIONS = {"linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}
_HASH_CHUNK_BYTES = 2**20
_QUIET = 4  # onnxruntime's log level "fatal", since its errors arrive as exceptions, too


class OnnxDepth:
    """Depth maps from one network. Implements `coec.calibration.types.DepthModel`; one caller at a time.

    The same image gives the same bytes on the same machine: one operator after another, deterministic
    kernels, no provider chosen at run time.
    """

    def __init__(
        self,
        path: Path,
        card: ModelCard,
        providers: Sequence[Provider],
        threads: int,
        limits: LimitsConfig,
        identity: str,
    ) -> None:
        """Open a network, compare it with its card, and run it once on a test image.

        Args:
            path: ONNX file; external weights lie beside it.
            card: what to feed the network and what its output means.
            providers: in order of preference; those that this machine lacks are left out, cpu is always the
                last.
            threads: threads of one operator.
            limits: bounds of the images that are decoded.
            identity: see `file_identity`.

        Raises:
            ModelError: there is no network, it is damaged, external weights are missing, input or output do not
                match the card, or the test image gives no finite value.
        """
        self._path = path
        self._card = card
        self._limits = limits
        self._identity = identity
        self._session = _open_session(path, providers, threads)
        self._input_name, self._own_size = self._check_input()
        self._output_name = self._check_output()
        self._try_out()
        logger.info("depth network %s (%s) on %s", card.name, path.name, ", ".join(self._session.get_providers()))

    @property
    def identity(self) -> str:
        """sha256 of the network, in hexadecimal."""
        return self._identity

    @property
    def card(self) -> ModelCard:
        """The card by which the network is run."""
        return self._card

    def infer(self, frame: CameraFrame) -> DepthMap:
        """The network's output for the frame's image, unchanged except that non-finite values become NaN.

        Raises:
            DecodeError: the image cannot be decoded, or its shape asks for a network input over
                `MAX_INPUT_PIXELS`.
            ModelError: the network failed on this input.
        """
        bgr = decode_bgr(frame.image, self._limits)
        height, width = self._own_size or self._card.input.size.size_for(*bgr.shape[:2])
        if height * width > MAX_INPUT_PIXELS:
            raise DecodeError(
                Refusal.IMAGE_TOO_LARGE,
                f"an image of {bgr.shape[1]}×{bgr.shape[0]} px would be {width}×{height} px for "
                f"{self._card.name}, more "
                f"than {MAX_INPUT_PIXELS} px in all: crop it, or use a card with a fixed size",
            )
        return DepthMap(self._run(to_tensor(bgr, self._card.input, height, width)))

    def _run(self, tensor: NDArray[np.float32]) -> NDArray[np.float32]:
        try:
            output = self._session.run([self._output_name], {self._input_name: tensor})[0]
        # onnxruntime's exceptions share no base but Exception, and none is documented for `run`
        except Exception as error:
            raise ModelError(
                f"{self._path} failed on an input of shape {list(tensor.shape)} (card {self._card.name}): {error}"
            ) from error
        values = np.asarray(output, dtype=np.float32)
        if values.ndim < 2 or values.size == 0 or values.size != values.shape[-1] * values.shape[-2]:
            raise ModelError(
                f"{self._path}: output {self._output_name!r} has shape {list(values.shape)}, expected one "
                "map of height × "
                f"width; name the right output in the card ({self._card.name})"
            )
        values = np.ascontiguousarray(values.reshape(values.shape[-2:]))
        return np.where(np.isfinite(values), values, np.float32(np.nan))

    def _check_input(self) -> tuple[str, tuple[int, int] | None]:
        """Name of the input, and its (height, width) in px if the network fixes them, else None."""
        card = self._card
        tensor = _pick(self._session.get_inputs(), card.input.name, "input", self._path, card.name)
        shape = list(tensor.shape)
        what = f"{self._path}: input {tensor.name!r} is {tensor.type} {shape}"
        if tensor.type != "tensor(float)":
            raise ModelError(f"{what}, expected tensor(float): export the network with float32 input")
        if len(shape) != 4 or not (_admits(shape[0], 1) and _admits(shape[1], 3)):
            raise ModelError(f"{what}, expected [1, 3, height, width]: export the network in this layout")
        height, width = shape[2:]
        if not (isinstance(height, int) and isinstance(width, int)):
            return tensor.name, None
        size = card.input.size
        if isinstance(size, FixedSize):
            fits = (size.height, size.width) == (height, width)
        else:
            fits = height % size.multiple == 0 and width % size.multiple == 0
        if not fits:
            raise ModelError(f"{what}, which does not fit the size in its card {card.name} ({size}): correct the card")
        return tensor.name, (height, width)

    def _check_output(self) -> str:
        tensor = _pick(self._session.get_outputs(), self._card.output.name, "output", self._path, self._card.name)
        if tensor.type not in ("tensor(float)", "tensor(float16)", "tensor(double)"):
            raise ModelError(f"{self._path}: output {tensor.name!r} is {tensor.type}, expected a map of floats")
        return str(tensor.name)

    def _try_out(self) -> None:
        """One run, so that a network that cannot work fails at the start instead of in the first window."""
        height, width = self._own_size or self._card.input.size.size_for(*TEST_IMAGE_SIZE)
        ramp = np.linspace(0.0, 255.0, height * width * 3, dtype=np.float32).astype(np.uint8)
        depth = self._run(to_tensor(ramp.reshape(height, width, 3), self._card.input, height, width))
        if not np.isfinite(depth).any():
            raise ModelError(
                f"{self._path} gives no finite value for a test image: check scale, mean and std in its card "
                f"({self._card.name}), or export the network again"
            )


def to_tensor(bgr: NDArray[np.uint8], card: CardInput, height: int, width: int) -> NDArray[np.float32]:
    """The input tensor, (1, 3, height, width), of an image (H, W, 3) in blue-green-red order.

    The image is resized as 8-bit values. If a network's authors resize floats, their cubic interpolation may leave 0 to
    255; here it is clipped.
    """
    source_height, source_width = bgr.shape[:2]
    if (source_height, source_width) != (height, width):
        if card.interpolation == "area":
            shrinks = height <= source_height and width <= source_width
            interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
        else:
            interpolation = _INTERPOLATIONS[card.interpolation]
        bgr = np.asarray(cv2.resize(bgr, (width, height), interpolation=interpolation), dtype=np.uint8)
    coloured = bgr[:, :, ::-1] if card.colour_order == "rgb" else bgr
    mean, std = (np.asarray(values, dtype=np.float32) for values in (card.mean, card.std))
    pixels = (coloured.astype(np.float32) * np.float32(card.scale) - mean) / std
    return np.ascontiguousarray(pixels.transpose(2, 0, 1)[np.newaxis])


def file_identity(path: Path) -> tuple[str, str]:
    """sha256 of an ONNX file, and the identity of the network: sha256 over that and its external weights.

    External weights are the files beside it whose names begin with its own (`model.onnx.data`,
    `model.onnx_data`: how PyTorch and Hugging Face name them). Without any, both are the same.

    Raises:
        ModelError: the file cannot be read.
    """
    digest = hashlib.sha256()
    try:
        _feed(digest, path)
        own = digest.hexdigest()
        for sibling in sorted(path.parent.iterdir()):
            if sibling.name.startswith((f"{path.name}.", f"{path.name}_")) and sibling.is_file():
                _feed(digest, sibling)
    except OSError as error:
        raise ModelError(cannot_read(Path(error.filename), error, "the depth network")) from error
    return own, digest.hexdigest()


def _feed(digest: Any, path: Path) -> None:
    with path.open("rb") as file:
        while chunk := file.read(_HASH_CHUNK_BYTES):
            digest.update(chunk)


def _open_session(path: Path, providers: Sequence[Provider], threads: int) -> Any:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    options.use_deterministic_compute = True
    # With an arena, inputs of each size would leave their blocks in it for ever (FIELD_NOTES, onnxruntime).
    options.enable_cpu_mem_arena = False
    options.enable_mem_pattern = False
    # Spinning threads would use the processor between frames: 39 % of a core against 1.9 % at 10 Hz (FIELD_NOTES).
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    options.log_severity_level = _QUIET
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=_available(providers))
    # onnxruntime's exceptions share no base but Exception
    except Exception as error:
        raise ModelError(
            f"{path} cannot be loaded as an ONNX network (damaged, incomplete, or external weights missing "
            "beside it): "
            f"{error}"
        ) from error
    # Without this, onnxruntime would silently replace a failing accelerator by the CPU, whose results have other bytes.
    session.disable_fallback()
    return session


def _available(providers: Sequence[Provider]) -> list[str]:
    present = onnxruntime.get_available_providers()
    requested: list[Provider] = [*(each for each in providers if each != "cpu"), "cpu"]
    selected = []
    for provider in requested:
        if PROVIDERS[provider] in present:
            selected.append(PROVIDERS[provider])
        else:
            logger.warning("onnxruntime on this machine has no %s: left out", provider)
    return selected


def _pick(tensors: Sequence[Any], name: str | None, kind: str, path: Path, card: str) -> Any:
    names = [tensor.name for tensor in tensors]
    if name is None and len(tensors) == 1:
        return tensors[0]
    if name not in names:
        requested = f"names {name!r}" if name is not None else "names none, and there are several"
        raise ModelError(f"{path} has the {kind}s {', '.join(names)}; its card ({card}) {requested}: correct the card")
    return tensors[names.index(name)]


def _admits(dimension: int | str | None, size: int) -> bool:
    """Whether a dimension of the network's input can be `size`; a free dimension is a name or None."""
    return dimension == size or not isinstance(dimension, int)
