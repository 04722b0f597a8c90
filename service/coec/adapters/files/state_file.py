"""The state that survives a restart: `state.json` with a checksum, and the previous good copy beside it.

The file is the canonical JSON (sorted keys, no spaces) of `{"body": …, "checksum": sha256 of the canonical body,
"schema_version": 1}`. A file counts as damaged unless it is byte for byte what this module would write for its body, so
that no flipped bit can be read as a calibration. An unusable file is kept beside the file that replaces it, as
`.broken`, or as `.newer` or `.older` if another version of the service wrote it.

All versions of the service so far write `schema_version` 1, so that each can read what the others wrote; what stands in
the body carries versions of its own. A file of a later schema version, whose checksum covers the version, too, is read
all the same, and is kept aside when it is replaced.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coec.adapters.files import durable
from coec.errors import StateError

SCHEMA_VERSION = 1

MAX_STATE_BYTES = 64 * 2**20
"""Largest file that is read. 32 pairs with everything that their state can hold take less than 1 MB."""

BROKEN, NEWER, OLDER = ".broken", ".newer", ".older"
"""Suffixes of files kept aside: damaged, or written by a newer or an older version of the service."""


@dataclass(frozen=True, slots=True)
class LoadedState:
    """What was found. `body` is None if there was no good copy; `damage` holds one sentence per bad copy."""

    body: dict[str, Any] | None
    damage: tuple[str, ...]


class _NewerError(StateError):
    """A copy that a later version of the service wrote."""


class StateFile:
    """One state file. Not safe for use from several threads at once."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._previous = path.with_name(path.name + ".previous")
        self._current_is_good = False
        self._loaded: Path | None = None
        self._quarantined: dict[Path, str] = {}

    def load(self) -> LoadedState:
        """The body of the current copy, else of the previous one, else None. Never raises for a bad file."""
        damage = []
        for path in (self._path, self._previous):
            try:
                body, version = _decode(_read(path))
            except FileNotFoundError:
                continue
            except OSError as error:
                damage.append(f"{path.name}: {error.strerror}")
            except StateError as error:
                damage.append(f"{path.name}: {error}")
                self._quarantined[path] = NEWER if isinstance(error, _NewerError) else BROKEN
            else:
                self._current_is_good, self._loaded = path == self._path, path
                if version > SCHEMA_VERSION:
                    self._quarantined[path] = NEWER
                return LoadedState(body, tuple(damage))
        return LoadedState(None, tuple(damage))

    def exists(self) -> bool:
        """Whether there is a current copy, good or not."""
        return self._path.exists()

    def reject(self, suffix: str = BROKEN) -> None:
        """Call this if the loaded body, or a part of it, turns out to be unusable: the copy that it came from is kept
        aside under `suffix` and does not become the previous copy. `BROKEN` outweighs the other suffixes."""
        if self._loaded is None:
            return
        if self._quarantined.get(self._loaded) != BROKEN:
            self._quarantined[self._loaded] = suffix
        self._current_is_good = False

    def save(self, body: dict[str, Any]) -> None:
        """Replace the file; the replaced copy, if good, becomes the previous one. Unusable copies that were found are
        kept aside first. On the disk when this returns.

        Raises:
            StateError: the disk is full or the folder not writable; a good copy stays on the disk.
        """
        try:
            for path in tuple(self._quarantined):
                durable.quarantine(path, self._quarantined[path])
                del self._quarantined[path]
            durable.replace(self._path, _encode(body), self._previous if self._current_is_good else None)
        except OSError as error:
            raise StateError(f"cannot write {self._path}: {error.strerror}; it needs space and permission") from error
        self._current_is_good, self._loaded = True, self._path


def _canonical(value: Any) -> bytes:
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False).encode()


def _encode(body: dict[str, Any], version: int = SCHEMA_VERSION) -> bytes:
    # The checksum of later versions covers the version: else one flipped bit would turn version 1 into a later one.
    covered = body if version == 1 else {"body": body, "schema_version": version}
    checksum = hashlib.sha256(_canonical(covered)).hexdigest()
    return _canonical({"body": body, "checksum": checksum, "schema_version": version})


def _read(path: Path) -> bytes:
    with path.open("rb") as stream:
        data = stream.read(MAX_STATE_BYTES + 1)
    if len(data) > MAX_STATE_BYTES:
        raise StateError(f"has more than {MAX_STATE_BYTES} bytes")
    return data


def _decode(data: bytes) -> tuple[dict[str, Any], int]:
    """The body, and the schema version of the envelope."""
    try:
        document = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise StateError("is not JSON") from error
    body = document.get("body") if isinstance(document, dict) else None
    if not isinstance(body, dict):
        raise StateError("has no body")
    version = document.get("schema_version")
    if type(version) is not int or version < SCHEMA_VERSION:
        raise StateError(f"is not of schema version {SCHEMA_VERSION}")
    try:
        expected = _encode(body, version)
    except (ValueError, RecursionError) as error:  # nesting that can be read may be too deep to write
        raise StateError("holds values that were never written") from error
    if expected == data:
        return body, version
    if version > SCHEMA_VERSION:
        raise _NewerError(
            f"is of a newer schema version than {SCHEMA_VERSION}, with a checksum that cannot be verified"
        )
    raise StateError("does not match its checksum")
