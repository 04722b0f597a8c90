"""The rig in its three forms: configuration, value, and JSON with a mask image (`rig.json`, `mask.png` of a window);
and the file with the baselines of a vehicle's commissioned pairs, with a checksum and the previous good copy beside
it.

History and reports refer to a baseline by the sha256 of its content. A field that is added later needs a default, and
versions before it refuse the whole document, because the first ones accept no field that they do not know.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
from cattrs import Converter, override
from numpy.typing import NDArray
from pydantic import ValidationError

from coec import config
from coec.calibration.baseline import Accuracy, Baseline, MonitorLimits, for_rig
from coec.calibration.monitor.sensor_faults import BANDS, BLOCK_COLUMNS, BLOCK_ROWS, SECTORS, SceneBaseline
from coec.calibration.types import CloudFrame, Matrix4, Rig, SweepTiming
from coec.config.poses import rigidity_problem
from coec.errors import ConfigError, DecodeError, StateError, WindowError, cannot_read, require_readable
from coec.geometry import cameras, se3
from coec.io import converter, storage
from coec.io.converter import POSE, MalformedValueError, array, make_converter, null_for, register, structured
from coec.io.images import decode_bgr, encode_png, probe

NOT_ALWAYS_THERE = ("sweep", "cloud")
"""Entries of `rig_identity` that a rig has only if they are configured."""

ROUNDING = 1e-9
"""Relative and absolute difference up to which two numbers of an identity count as equal: far below what any mount is
known to, far above the rounding of a double."""


def rig_of(pair: config.PairConfig) -> Rig:
    """The rig that a configuration describes; reads its mask.

    Raises:
        ConfigError: the model refuses the intrinsics, a matrix is not rigid, `lidar.metadata` does not exist, or the
            mask is absent, not an image, or not of the camera's size. Names the pair and the key.
    """
    camera = _camera(pair.camera.intrinsics, f"pair {pair.name}, camera.intrinsics")
    ego = pair.ego
    if pair.lidar.metadata is not None:
        require_readable(pair.lidar.metadata, f"pair {pair.name}, lidar.metadata")
    return Rig(
        pair=pair.name,
        camera=camera,
        camera_frame=pair.camera.frame_id,
        lidar_frame=pair.lidar.frame_id,
        T_camera_lidar_nominal=rigid_matrix(pair.T_camera_lidar, f"pair {pair.name}, T_camera_lidar"),
        T_lidar_ego=np.eye(4) if ego is None else rigid_matrix(ego.T_lidar_ego, f"pair {pair.name}, ego.T_lidar_ego"),
        mask=None if pair.camera.mask is None else load_mask(pair.camera.mask, camera),
        sweep=None if pair.lidar.sweep is None else _sweep(pair.lidar.sweep),
        cloud=_cloud(pair.lidar, f"pair {pair.name}, lidar.T_cloud_lidar"),
    )


def check_given(pair: config.OpenPairConfig) -> None:
    """Checks the parts of an awaited pair's rig that the configuration gives, as far as possible without the rest.

    Raises:
        ConfigError: the model refuses the intrinsics, a matrix is not rigid, or a file does not exist.
    """
    where = f"pair {pair.name}"
    if pair.camera.intrinsics is not None:
        _camera(pair.camera.intrinsics, f"{where}, camera.intrinsics")
    if pair.camera.mask is not None:
        require_readable(pair.camera.mask, f"{where}, camera.mask")
    if pair.lidar.metadata is not None:
        require_readable(pair.lidar.metadata, f"{where}, lidar.metadata")
    matrices = {
        "T_camera_lidar": pair.T_camera_lidar,
        "lidar.T_cloud_lidar": pair.lidar.T_cloud_lidar,
        "ego.T_lidar_ego": None if pair.ego is None else pair.ego.T_lidar_ego,
    }
    for name, rows in matrices.items():
        if rows is not None:
            rigid_matrix(rows, f"{where}, {name}")


def camera_of(intrinsics: config.CameraIntrinsics) -> cameras.Camera:
    """The camera that intrinsics describe.

    Raises:
        ConfigError: a parameter is missing, not of this model, or out of range; names it.
    """
    return _camera(intrinsics, "camera")


def rigid_matrix(rows: config.Matrix4x4, where: str) -> Matrix4:
    """(4, 4) float64, checked to be a rotation and a translation.

    Raises:
        ConfigError: it is not; the message names `where`.
    """
    T = np.array(rows, dtype=np.float64)
    if not se3.is_rigid(T):
        raise ConfigError(f"{where} is not a rigid transform: {rigidity_problem(rows)}")
    return T


def load_mask(path: Path, camera: cameras.Camera) -> NDArray[np.bool_]:
    """(height, width) bool from a PNG or JPEG: False at pixels that are black in every channel.

    Raises:
        ConfigError: unreadable, not an image, or not of the camera's size.
    """
    try:
        return mask_from_image(path.read_bytes(), camera)
    except OSError as error:
        raise ConfigError(cannot_read(path, error, "mask")) from error
    except DecodeError as error:
        raise ConfigError(f"mask {path}: {error}") from error


def mask_from_image(data: bytes, camera: cameras.Camera) -> NDArray[np.bool_]:
    """(height, width) bool from an encoded image, likewise.

    Raises:
        DecodeError: not an image, or not of the camera's size.
    """
    limits = config.LimitsConfig()
    image = probe(data, limits)
    if (image.width, image.height) != (camera.width, camera.height):
        raise DecodeError(
            "image_size_mismatch",
            f"the mask is {image.width} x {image.height} px, the camera {camera.width} x {camera.height} px",
        )
    return np.asarray(decode_bgr(image, limits).any(axis=2))


def mask_to_png(mask: NDArray[np.bool_]) -> bytes:
    """A grey PNG, 255 at pixels where the mask is True, else 0."""
    return encode_png(np.where(mask, np.uint8(255), np.uint8(0)))


def intrinsics_config(camera: cameras.Camera) -> config.CameraIntrinsics:
    """The intrinsics as a configuration holds them."""
    return config.CameraIntrinsics.model_validate({"model": cameras.name_of(camera), **cameras.intrinsics_of(camera)})


def rig_to_json(rig: Rig) -> dict[str, Any]:
    """The rig without its mask, as JSON values; floats are written so that they read back to the same bits."""
    document: dict[str, Any] = _FORM.unstructure(rig)
    return document


IDENTIFYING = (
    "pair", "camera", "camera_frame", "lidar_frame", "T_camera_lidar_nominal", "T_lidar_ego", *NOT_ALWAYS_THERE,
)  # fmt: skip
"""Entries of `rig_to_json` that make a calibration belong to a rig: names, frames, intrinsics, nominal pose, and how
points are placed."""


def rig_identity(rig: Rig) -> dict[str, Any]:
    """What makes a calibration belong to this rig, as JSON values. What is not configured has no entry.

    The form is fixed, because `identity_sha256` of it is in the state directories of all versions. A later version may
    add an entry for something that it newly knows, if it leaves that entry out where the rig is as earlier versions
    took it to be.
    """
    document = rig_to_json(rig)
    return {name: document[name] for name in IDENTIFYING if name in document}


def identity_sha256(identity: dict[str, Any]) -> str:
    """The sha256 (hexadecimal) by which versions without `rig_identity` in their state know the rig."""
    return hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()


def is_same_rig(rig: Rig, stored: Mapping[str, Any]) -> bool:
    """Whether a stored `rig_identity`, of this version or another one, is that of a rig. Entries that only the other
    version knows are ignored, and numbers may differ by rounding."""
    identity = rig_identity(rig)
    return all(_is_equal(identity.get(name), stored.get(name)) for name in identity.keys() | NOT_ALWAYS_THERE)


def _is_equal(value: Any, stored: Any) -> bool:
    match value:
        case dict():
            return isinstance(stored, dict) and all(_is_equal(value[name], stored.get(name)) for name in value)
        case list():
            same_length = isinstance(stored, list) and len(value) == len(stored)
            return same_length and all(_is_equal(one, other) for one, other in zip(value, stored, strict=True))
        case float():
            return isinstance(stored, float) and math.isclose(value, stored, rel_tol=ROUNDING, abs_tol=ROUNDING)
        case _:
            return bool(value == stored)


def rig_from_json(document: object, mask_png: bytes | None) -> Rig:
    """The exact inverse of `rig_to_json` and `mask_to_png`.

    Raises:
        WindowError: not a valid document; says where.
    """
    try:
        rig = converter.structured(_FORM, document, Rig)
        return rig if mask_png is None else replace(rig, mask=mask_from_image(mask_png, rig.camera))
    except (converter.MalformedValueError, DecodeError) as error:
        raise WindowError(f"the rig is damaged: {error}") from error


def matrix_rows(T: Matrix4) -> config.Matrix4x4:
    """(4, 4) as nested tuples of Python floats."""
    a, b, c, d = ((float(w), float(x), float(y), float(z)) for w, x, y, z in T)
    return a, b, c, d


def _camera(intrinsics: config.CameraIntrinsics, where: str) -> cameras.Camera:
    try:
        return cameras.build(intrinsics.model, **intrinsics.parameters())
    except ValueError as error:
        raise ConfigError(f"{where}: {error}") from error


def _cloud(lidar: config.LidarConfig, where: str) -> CloudFrame | None:
    if lidar.cloud_frame_id is None and lidar.T_cloud_lidar == config.IDENTITY:
        return None
    return CloudFrame(lidar.cloud_frame_id or lidar.frame_id, rigid_matrix(lidar.T_cloud_lidar, where))


def _sweep(sweep: config.SweepConfig) -> SweepTiming:
    return SweepTiming(sweep.period_s, sweep.sign, math.radians(sweep.stamp_azimuth_deg))


def _rig_form() -> Converter:
    """The rules by which a `Rig` is written and read. The mask is a file of its own; a sweep or cloud that is not
    configured has no entry."""
    form = converter.make_converter()
    # The fields of a camera depend on its model: they are those of the configuration.
    form.register_unstructure_hook_func(
        lambda one: one == cameras.Camera,
        lambda camera: intrinsics_config(camera).model_dump(mode="json", exclude_none=True),
    )
    form.register_structure_hook_func(lambda one: one == cameras.Camera, _read_camera)
    period_s = converter.bounded(converter.number, lambda value: value > 0.0, "a number above 0")
    sign = converter.bounded(converter.whole_number, lambda value: value in (-1, 1), "-1 or 1")
    converter.register(form, SweepTiming, required=["stamp_azimuth_rad"], period_s=period_s, sign=sign)
    converter.register(form, CloudFrame, T_cloud_lidar=converter.POSE)
    elsewhere, not_always_there = override(omit=True), override(omit_if_default=True)
    converter.register(
        form,
        Rig,
        T_camera_lidar_nominal=converter.POSE,
        T_lidar_ego=converter.POSE,
        mask=elsewhere,
        sweep=not_always_there,
        camera_residual_px=elsewhere,
        cloud=not_always_there,
    )
    return form


def _read_camera(value: Any, _: object) -> cameras.Camera:
    try:
        intrinsics = config.CameraIntrinsics.model_validate(value)
        return cameras.build(intrinsics.model, **intrinsics.parameters())
    except ValueError as error:
        raise converter.MalformedValueError(
            config.describe(error) if isinstance(error, ValidationError) else str(error)
        ) from error


_FORM = _rig_form()


# --- baselines --------------------------------------------------------------------------------------------------------

BASELINES = "rig.json"
"""File in the state directory with what was learned when the pairs were commissioned."""


def _baseline_form() -> Converter:
    """The rules by which a `Baseline` is written and read."""
    form = make_converter()
    # NaN, on axes that are not searched, and limits that refuse nothing are null.
    axes = array(6, null=True)
    register(form, Accuracy, bias=axes, bias_sigma=axes, spread=axes)
    most, least = null_for(inf), null_for(-inf)
    # Only the first versions wrote no share.
    required = [field.name for field in fields(MonitorLimits) if field.name != "insisted_share"]
    register(form, MonitorLimits, required=required, max_agreement_rad=most, max_f1=most, min_mi=least, min_f2=least)
    # Exactly as many parts as the monitor uses.
    gradient = array(BLOCK_ROWS, BLOCK_COLUMNS)
    register(form, SceneBaseline, gradient=gradient, bands=array(BANDS), sectors=array(SECTORS))
    register(form, Baseline, T_camera_lidar=POSE)
    return form


_BASELINE_FORM = _baseline_form()


def save_baseline(path: Path, baseline: Baseline) -> str:
    """Adds a baseline to `rig.json`, or replaces that of its pair. Returns its hash, once it is on the disk.

    Raises:
        StateError: the disk is full or the folder not writable.
    """
    file = storage.StateFile(path)
    document = baseline_to_json(baseline)
    pairs = {**_pairs_of(file.load().body), baseline.pair: document}
    try:
        storage.make_folder(path.parent)
    except OSError as error:
        raise StateError(f"cannot make the folder {path.parent}: {error.strerror}") from error
    file.save({"pairs": pairs})
    return document_hash(document)


def load_baseline(path: Path, pair: str) -> Baseline | None:
    """The baseline of a pair; None if there is none.

    Raises:
        StateError: the file and its previous copy are damaged.
    """
    document = _documents(path).get(pair)
    return None if document is None else baseline_from_json(document)


def load_baselines(path: Path) -> dict[str, Baseline]:
    """All baselines in a file, by pair; empty if there is no file.

    Raises:
        StateError: as `load_baseline`.
    """
    return {pair: baseline_from_json(document) for pair, document in _documents(path).items()}


def baseline_of_rig(rig: Rig, state: config.StateConfig) -> Baseline | None:
    """The baseline of a rig: the one learned when it was commissioned, else the one of its vehicle model if the
    configuration names a file for that; None if there is neither.

    Raises:
        StateError: a file is damaged, or that of the model has no baseline of this pair.
    """
    own = load_baseline(state.directory / BASELINES, rig.pair)
    if own is not None or state.model is None:
        return own
    model = load_baseline(state.model, rig.pair)
    if model is None:
        raise StateError(f"{state.model} (state.model) has no baseline of the pair {rig.pair}: coec fleet commission")
    return for_rig(model, rig)


def baseline_hash(baseline: Baseline) -> str:
    """First 16 hexadecimal digits of the sha256 of the canonical JSON."""
    return document_hash(baseline_to_json(baseline))


def document_hash(document: dict[str, Any]) -> str:
    """The same for a document."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def baseline_to_json(baseline: Baseline) -> dict[str, Any]:
    """The baseline as JSON values; floats are written so that they read back to the same bits."""
    document: dict[str, Any] = _BASELINE_FORM.unstructure(baseline)
    return document


def baseline_from_json(values: object) -> Baseline:
    """The exact inverse of `baseline_to_json`.

    Raises:
        StateError: not a valid document; says where.
    """
    try:
        return structured(_BASELINE_FORM, values, Baseline)
    except MalformedValueError as error:
        raise StateError(f"the baseline cannot be read: {error}; commission again") from error


def _documents(path: Path) -> dict[str, Any]:
    loaded = storage.StateFile(path).load()
    if loaded.body is None and loaded.damage:
        raise StateError(f"{path} cannot be used: {'; '.join(loaded.damage)}; commission again")
    return _pairs_of(loaded.body)


def _pairs_of(body: dict[str, Any] | None) -> dict[str, Any]:
    pairs = {} if body is None else body.get("pairs")
    return pairs if isinstance(pairs, dict) else {}
