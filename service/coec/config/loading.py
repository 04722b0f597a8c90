"""Reads a YAML file into the configuration of a daemon. Size, depth and number of values are bounded before anything
is built; error messages name the key that is wrong.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from coec.config.model import describe
from coec.config.pair import OpenPairConfig
from coec.config.rig import expand_rig, is_rig
from coec.config.root import Config
from coec.errors import ConfigError, cannot_read

MAX_YAML_BYTES = 2**20
"""Largest YAML file: enough for the 10,000 frames of a manifest, and for far more than the allowed pairs. A file of
this size with few values is read in 1 s (one core at 3 GHz)."""

MAX_YAML_DEPTH = 32
"""Deepest nesting; no file of coec is nested deeper than 6."""

MAX_YAML_VALUES = 100_000
"""Most values of a file, keys included; each takes 35 µs to read. Enough for a manifest of 5,200 frames with a velocity
each, or of 14,000 without."""

MERGE = "tag:yaml.org,2002:merge"


def load_yaml(path: Path) -> Any:
    """The document of a YAML 1.2 file.

    Raises:
        ConfigError: the file cannot be read or is not YAML.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_YAML_BYTES + 1)
    except OSError as error:
        raise ConfigError(cannot_read(path, error)) from error
    if not data.strip():
        raise ConfigError(f"{path} is empty")
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        detail = f"byte {error.start} is no text in UTF-8"
        raise ConfigError(f"{path} is not valid YAML: {detail}; is it the right file?") from error
    try:
        return parse_yaml(text)
    except ConfigError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error


def parse_yaml(text: str) -> Any:
    """The document of a YAML 1.2 text.

    Raises:
        ConfigError: the text is not YAML, or exceeds one of the limits above.
    """
    if len(text) > MAX_YAML_BYTES:
        raise ConfigError(f"it has more than {MAX_YAML_BYTES} bytes")
    reader = YAML(typ="safe", pure=True)
    reader.max_depth = MAX_YAML_DEPTH
    reader.Composer = _BoundedComposer
    try:
        document = reader.load(text)
    except ConfigError:
        raise
    except MarkedYAMLError as error:
        raise ConfigError(_error_with_position(error)) from error
    except YAMLError as error:
        raise ConfigError(" ".join(str(error).split())) from error
    except (
        Exception
    ) as error:  # constructors of numbers, dates and the like raise any exception that Python's own raise
        raise ConfigError(f"a value in it is invalid: {type(error).__name__}") from error
    _check_extent(document)
    return document


def _error_with_position(error: MarkedYAMLError) -> str:
    """One line that says what is wrong and where."""
    mark = error.problem_mark
    where = "" if mark is None else f"line {mark.line + 1}, column {mark.column + 1}: "
    return " ".join(f"{where}{error.problem or error.context or 'no YAML'}".split())


class _BoundedComposer(Composer):
    """Refuses a document while reading it, as soon as it has too many values. It also refuses merge keys: YAML 1.2 does
    not have them, and they would copy values over and over."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader)
        self._values = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._values += 1
        if self._values > MAX_YAML_VALUES:
            raise ConfigError(f"it has more than {MAX_YAML_VALUES} values")
        node = super().compose_node(parent, index)
        if node.tag == MERGE:
            raise ConfigError("`<<` is no part of YAML 1.2: write the keys out, or give a whole value by its alias")
        return node


def _check_extent(document: object) -> None:
    """Checks depth and number of values again with all aliases followed, as a validator would: with aliases a short
    text can make a huge, even endless document."""
    stack, values = [(document, 0)], 0
    while stack:
        value, depth = stack.pop()
        values += 1
        if depth > MAX_YAML_DEPTH or values > MAX_YAML_VALUES:
            raise ConfigError(f"it is nested deeper than {MAX_YAML_DEPTH}, or has more than {MAX_YAML_VALUES} values")
        if isinstance(value, dict):
            stack += ((item, depth + 1) for item in value.values())
        elif isinstance(value, list):
            stack += ((item, depth + 1) for item in value)


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
