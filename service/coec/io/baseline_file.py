"""`rig.json`: the baselines of a vehicle's commissioned pairs, with a checksum and the previous good copy beside it.

History and reports refer to a baseline by the sha256 of its content. A field that is added later needs a default, and
versions before it refuse the whole document, because the first ones accept no field that they do not know.
"""

import hashlib
import json
from dataclasses import fields
from math import inf
from pathlib import Path
from typing import Any

from cattrs import Converter

from coec.calibration.baseline import Accuracy, Baseline, MonitorLimits, for_rig
from coec.calibration.monitor.sensor_faults import BANDS, BLOCK_COLUMNS, BLOCK_ROWS, SECTORS, SceneBaseline
from coec.calibration.types import Rig
from coec.config import StateConfig
from coec.errors import StateError
from coec.io import storage
from coec.io.converter import POSE, MalformedValueError, array, make_converter, null_for, register, structured
from coec.io.storage import StateFile

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


_FORM = _baseline_form()


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
    """The baseline as JSON values; floats are written so that they read back to the same bits."""
    document: dict[str, Any] = _FORM.unstructure(baseline)
    return document


def baseline_from_json(values: object) -> Baseline:
    """The exact inverse of `baseline_to_json`.

    Raises:
        StateError: not a valid document; says where.
    """
    try:
        return structured(_FORM, values, Baseline)
    except MalformedValueError as error:
        raise StateError(f"the baseline cannot be read: {error}; commission again") from error


def _documents(path: Path) -> dict[str, Any]:
    loaded = StateFile(path).load()
    if loaded.body is None and loaded.damage:
        raise StateError(f"{path} cannot be used: {'; '.join(loaded.damage)}; commission again")
    return _pairs_of(loaded.body)


def _pairs_of(body: dict[str, Any] | None) -> dict[str, Any]:
    pairs = {} if body is None else body.get("pairs")
    return pairs if isinstance(pairs, dict) else {}
