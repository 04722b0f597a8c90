"""`rig.json`: the baselines of a vehicle's commissioned pairs, with a checksum and the previous good copy beside it.

History and reports refer to a baseline by the sha256 of its content. A field that is added later needs a default, and
versions before it refuse the whole document, because the first ones accept no field that they do not know.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from coec.calibration.baseline import Accuracy, Baseline, MonitorLimits, for_rig
from coec.calibration.monitor.sensor_faults import BANDS, BLOCK_COLUMNS, BLOCK_ROWS, SECTORS, SceneBaseline
from coec.calibration.types import Rig
from coec.config import Matrix4x4, StateConfig, describe
from coec.errors import ConfigError, StateError
from coec.io import storage
from coec.io.rig_files import matrix_rows, rigid_matrix
from coec.io.storage import StateFile

Maybe6 = tuple[float | None, float | None, float | None, float | None, float | None, float | None]


def _length(count: int) -> FieldInfo:
    field: FieldInfo = Field(min_length=count, max_length=count)
    return field


BASELINES = "rig.json"
"""File in the state directory with what was learned when the pairs were commissioned."""


class _Document(BaseModel):
    # A later version may have added fields: older ones read the rest.
    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)


class AccuracyDocument(_Document):
    """`Accuracy` (rad, m); null on axes that are not searched."""

    bias: Maybe6
    bias_sigma: Maybe6
    spread: Maybe6


class LimitsDocument(_Document):
    """`MonitorLimits`; null: no limit. A limit that a file of an earlier version lacks refuses nothing."""

    max_distance2_rotation: float
    max_farthest2_pose: float
    min_edges_per_pair: float
    insisted_share: float = 1.0
    max_agreement_rad: float | None
    min_overlap: float
    min_mi: float | None
    max_f1: float | None
    min_f2: float | None


class SceneDocument(_Document):
    """`SceneBaseline`, with exactly as many parts as the monitor uses."""

    gradient: Annotated[tuple[Annotated[tuple[float, ...], _length(BLOCK_COLUMNS)], ...], _length(BLOCK_ROWS)]
    bands: Annotated[tuple[float, ...], _length(BANDS)]
    sectors: Annotated[tuple[float, ...], _length(SECTORS)]
    range_edges: float


class BaselineDocument(_Document):
    """`Baseline`; floats are written so that they read back to the same bits."""

    pair: str
    T_camera_lidar: Matrix4x4
    rotation: AccuracyDocument
    pose: AccuracyDocument
    dof: int
    limits: dict[str, float]
    monitor: LimitsDocument
    scene: SceneDocument
    false_alarm_rate: float
    windows: int
    pairs: int
    detected: dict[str, float]
    sensors: dict[str, str]
    depth_identity: str
    config_hash: str


def save_baseline(path: Path, baseline: Baseline) -> str:
    """Adds a baseline to `rig.json`, or replaces that of its pair. Returns its hash, once it is on the disk.

    Raises:
        StateError: the disk is full or the folder not writable.
    """
    file = StateFile(path)
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


def baseline_of_rig(rig: Rig, state: StateConfig) -> Baseline | None:
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
    """The baseline as JSON values."""
    limits, scene = baseline.monitor, baseline.scene
    document = BaselineDocument(
        pair=baseline.pair,
        T_camera_lidar=matrix_rows(baseline.T_camera_lidar),
        rotation=_accuracy_document(baseline.rotation),
        pose=_accuracy_document(baseline.pose),
        dof=baseline.dof,
        limits=baseline.limits,
        monitor=LimitsDocument(
            max_distance2_rotation=limits.max_distance2_rotation,
            max_farthest2_pose=limits.max_farthest2_pose,
            min_edges_per_pair=limits.min_edges_per_pair,
            insisted_share=limits.insisted_share,
            max_agreement_rad=_finite(limits.max_agreement_rad),
            min_overlap=limits.min_overlap,
            min_mi=_finite(limits.min_mi),
            max_f1=_finite(limits.max_f1),
            min_f2=_finite(limits.min_f2),
        ),
        scene=SceneDocument(
            gradient=tuple(_floats(row) for row in scene.gradient),
            bands=_floats(scene.bands),
            sectors=_floats(scene.sectors),
            range_edges=scene.range_edges,
        ),
        false_alarm_rate=baseline.false_alarm_rate,
        windows=baseline.windows,
        pairs=baseline.pairs,
        detected=baseline.detected,
        sensors=baseline.sensors,
        depth_identity=baseline.depth_identity,
        config_hash=baseline.config_hash,
    )
    values: dict[str, Any] = document.model_dump(mode="json")
    return values


def baseline_from_json(values: object) -> Baseline:
    """The exact inverse of `baseline_to_json`.

    Raises:
        StateError: not a valid document; says where.
    """
    try:
        document = BaselineDocument.model_validate(values)
        T_camera_lidar = rigid_matrix(document.T_camera_lidar, "T_camera_lidar")
    except (ValidationError, ConfigError) as error:
        what = describe(error) if isinstance(error, ValidationError) else str(error)
        raise StateError(f"the baseline cannot be read: {what}; commission again") from error
    limits = document.monitor
    return Baseline(
        pair=document.pair,
        T_camera_lidar=T_camera_lidar,
        rotation=_accuracy(document.rotation),
        pose=_accuracy(document.pose),
        dof=document.dof,
        limits=document.limits,
        monitor=MonitorLimits(
            max_distance2_rotation=limits.max_distance2_rotation,
            max_farthest2_pose=limits.max_farthest2_pose,
            min_edges_per_pair=limits.min_edges_per_pair,
            insisted_share=limits.insisted_share,
            max_agreement_rad=_or(limits.max_agreement_rad, math.inf),
            min_overlap=limits.min_overlap,
            min_mi=_or(limits.min_mi, -math.inf),
            max_f1=_or(limits.max_f1, math.inf),
            min_f2=_or(limits.min_f2, -math.inf),
        ),
        scene=SceneBaseline(
            gradient=np.array(document.scene.gradient, dtype=np.float64),
            bands=np.array(document.scene.bands, dtype=np.float64),
            sectors=np.array(document.scene.sectors, dtype=np.float64),
            range_edges=document.scene.range_edges,
        ),
        false_alarm_rate=document.false_alarm_rate,
        windows=document.windows,
        pairs=document.pairs,
        detected=document.detected,
        sensors=document.sensors,
        depth_identity=document.depth_identity,
        config_hash=document.config_hash,
    )


def _documents(path: Path) -> dict[str, Any]:
    loaded = StateFile(path).load()
    if loaded.body is None and loaded.damage:
        raise StateError(f"{path} cannot be used: {'; '.join(loaded.damage)}; commission again")
    return _pairs_of(loaded.body)


def _pairs_of(body: dict[str, Any] | None) -> dict[str, Any]:
    pairs = {} if body is None else body.get("pairs")
    return pairs if isinstance(pairs, dict) else {}


def _accuracy_document(accuracy: Accuracy) -> AccuracyDocument:
    return AccuracyDocument(
        bias=_maybe6(accuracy.bias), bias_sigma=_maybe6(accuracy.bias_sigma), spread=_maybe6(accuracy.spread)
    )


def _accuracy(document: AccuracyDocument) -> Accuracy:
    return Accuracy(_array(document.bias), _array(document.bias_sigma), _array(document.spread))


def _maybe6(values: NDArray[np.float64]) -> Maybe6:
    a, b, c, d, e, f = (_finite(float(value)) for value in values)
    return a, b, c, d, e, f


def _array(values: Iterable[float | None]) -> NDArray[np.float64]:
    return np.array([_or(value, math.nan) for value in values], dtype=np.float64)


def _floats(values: NDArray[np.float64]) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
