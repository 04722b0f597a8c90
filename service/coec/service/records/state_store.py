"""The states of all pairs, in one state file."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from coec.calibration.state import CalibrationStatus, PairState, Provenance, initial_state
from coec.calibration.types import Rig
from coec.errors import NotFoundError, StateError
from coec.io.storage import BROKEN, NEWER, OLDER, StateFile
from coec.service.records.stored_pair import (
    OF_FIRST_VERSIONS,
    AnotherRigError,
    Clocks,
    RestoredPair,
    StoredPair,
    pair_from_json,
    pair_to_json,
)

_log = logging.getLogger(__name__)


STATE_FILE = "state.json"

_SUFFIX: Final[Mapping[Literal["older", "newer"] | None, str]] = {"older": OLDER, "newer": NEWER, None: BROKEN}
"""Suffix under which a file is kept aside, by the version that wrote the part that cannot be read."""


class StateStore:
    """Keeps the state file; safe to use from several threads. Only `flush` waits for the disk.

    Attributes:
        damage: what was wrong with the copies found at the start, one sentence each.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        self._file = StateFile(folder / STATE_FILE)
        self._vehicle = vehicle
        self._lock = threading.Lock()
        self._writing = threading.Lock()
        self._heads: dict[str, Callable[[], Mapping[str, str]]] = {}
        loaded = self._file.load()
        self.damage = loaded.damage
        pairs = loaded.body.get("pairs") if loaded.body else None
        self._pairs: dict[str, Any] = pairs if isinstance(pairs, dict) else {}

    def load(self, rig: Rig) -> RestoredPair | None:
        """What is known of the pair, as far as it can be read; None if nothing is, or if it belongs to another rig,
        which is logged. If a part cannot be read, the file is kept aside when the state is next put on the disk.

        Raises:
            StateError: nothing of the pair can be read. The file is kept aside likewise.
        """
        document = self._pairs.get(rig.pair)
        if document is None:
            return None
        if not isinstance(document, dict):
            self._file.reject()
            raise StateError(f"the state of pair {rig.pair} is no JSON object")
        try:
            _, remembered = pair_from_json(document, rig, initial_state(rig))
        except AnotherRigError:
            _log.warning(
                "the state on the disk belongs to another rig: starting from nominal",
                extra={"fields": {"pair": rig.pair}},
            )
            return None
        for lost in remembered.lost:
            self._file.reject(_SUFFIX[lost.written_by])
            fields = {"pair": rig.pair, "part": lost.part, "why": lost.why}
            _log.warning("a part of the state on the disk cannot be read", extra={"fields": fields})
        if document.keys() - StoredPair.model_fields - OF_FIRST_VERSIONS:
            self._file.reject(NEWER)
            text = "a newer version wrote fields of the state that this one does not know: the file is kept aside"
            _log.info(text, extra={"fields": {"pair": rig.pair}})
        return remembered

    def update(
        self,
        rig: Rig,
        state: PairState,
        clocks: Clocks,
        history_heads: Callable[[], Mapping[str, str]],
        commissioned_from: tuple[str, ...] = (),
    ) -> None:
        """Keeps the pair's state, and the ids of the windows from which it was commissioned. The next `flush` writes
        them, together with what `history_heads()` returns then."""
        document = pair_to_json(rig, self._vehicle, state, clocks, commissioned_from)
        with self._lock:
            self._pairs[rig.pair] = document
            self._heads[rig.pair] = history_heads

    def flush(self) -> None:
        """Writes what is kept to the disk.

        Raises:
            StateError: the disk refuses; the next call tries again.
        """
        with self._writing:
            with self._lock:
                pairs, heads = dict(self._pairs), dict(self._heads)
            # Entries of pairs that this service does not know may have any form, and stay as they are.
            updated = {pair: {**pairs[pair], "history_heads": dict(of_pair())} for pair, of_pair in heads.items()}
            self._file.save({"pairs": {**pairs, **updated}})


def read_pairs(folder: Path) -> dict[str, tuple[StoredPair, PairState]]:
    """What a state directory holds of every pair whose extrinsic can be read, for programs that read it beside the
    service or without one. Other parts that cannot be read have their defaults, as in the service.

    Raises:
        NotFoundError: the directory holds no state file.
        StateError: no copy of the state file, or none of its extrinsics, can be used; the message says why.
    """
    loaded = StateFile(folder / STATE_FILE).load()
    if loaded.body is None:
        if loaded.damage:
            raise StateError(f"{folder / STATE_FILE} cannot be used: {'; '.join(loaded.damage)}")
        raise NotFoundError(f"{folder} holds no {STATE_FILE}")
    documents = loaded.body.get("pairs")
    readable: dict[str, tuple[StoredPair, PairState]] = {}
    refused = [] if isinstance(documents, dict) else ["it lists no pairs"]
    for name, document in (documents if isinstance(documents, dict) else {}).items():
        if not isinstance(document, dict):
            refused.append(f"pair {name} is no JSON object")
            continue
        unknown = PairState(np.eye(4), Provenance.NOMINAL, CalibrationStatus.NOT_ACCEPTED, 0)
        stored, remembered = pair_from_json(document, None, unknown)
        extrinsic = [lost.why for lost in remembered.lost if lost.part == "extrinsic"]
        if extrinsic:
            refused.append(f"the extrinsic of pair {name} is {extrinsic[0]}")
        else:
            readable[name] = stored, remembered.state
    if refused and not readable:
        raise StateError(f"{folder / STATE_FILE} cannot be used: {'; '.join(refused)}")
    return readable
