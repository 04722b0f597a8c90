"""Reads a user's file into the configuration of a daemon; error messages name the key that is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from coec.config.base import describe
from coec.config.pair import OpenPairConfig
from coec.config.rig import expand_rig, is_rig
from coec.config.whole import Config
from coec.config.yaml_text import load_yaml
from coec.errors import ConfigError


def load_config(path: Path) -> Config:
    """The validated configuration of a daemon; relative paths in it are relative to the file.

    Raises:
        ConfigError: unreadable, not YAML, unknown key, wrong type or value out of range; names each place.
    """
    document = load_yaml(path)
    try:
        return _resolve_paths(config_of(document), path.parent)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def config_of(document: Any) -> Config:
    """The configuration of a document, which may be in the form that lists each sensor once (see `config.rig`).

    Raises:
        ConfigError: no mapping, unknown key, wrong type or value out of range; names each place.
    """
    if not isinstance(document, dict):
        raise ConfigError(f"expected a mapping at the top, found {type(document).__name__}")
    if is_rig(document):
        document = expand_rig(document)
    try:
        return Config.model_validate(document)
    except ValidationError as error:
        raise ConfigError(describe(error)) from error


def _resolve_paths(config: Config, folder: Path) -> Config:
    """Relative paths are relative to the configuration file, not to wherever the daemon was started."""
    zenoh = config.zenoh
    if zenoh.file is not None:
        zenoh = zenoh.model_copy(update={"file": folder / zenoh.file})
    authority_paths = config.authority
    files = {
        "certificate": authority_paths.certificate,
        "private_key": authority_paths.private_key,
        "root_ca": authority_paths.root_ca,
    }
    authority = authority_paths.model_copy(
        update={name: None if path is None else folder / path for name, path in files.items()}
    )
    state = config.state.model_copy(update={"directory": folder / config.state.directory})
    pairs = tuple(_resolve_pair_paths(pair, folder) for pair in config.pairs)
    incomplete = tuple(_resolve_pair_paths(pair, folder) for pair in config.awaited)
    return config.model_copy(
        update={"pairs": pairs, "awaited": incomplete, "state": state, "zenoh": zenoh, "authority": authority}
    )


_P = TypeVar("_P", bound=OpenPairConfig)


def _resolve_pair_paths(pair: _P, folder: Path) -> _P:
    camera, depth = pair.camera, pair.calibration.depth
    if camera.mask is not None:
        camera = camera.model_copy(update={"mask": folder / camera.mask})
    if depth.model.endswith(".onnx"):
        depth = depth.model_copy(update={"model": str(folder / depth.model)})
    calibration = pair.calibration.model_copy(update={"depth": depth})
    return pair.model_copy(update={"camera": camera, "calibration": calibration})
