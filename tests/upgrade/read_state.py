"""Reads a state directory with the version of coec on PYTHONPATH, and prints what that version makes of it, as JSON.

    PYTHONPATH=service:tests python tests/upgrade/read_state.py STATE EXPECTED

EXPECTED is the file that `write_state` leaves beside the directory; it says of which rigs the state is.
"""

from __future__ import annotations

import inspect
import json
import sys
from pathlib import Path
from typing import Any

from coec.calibration import state as lifecycle
from coec.calibration.state import PairState
from coec.io.baseline_file import BASELINES, load_baseline
from coec.io.rig_files import rig_from_json
from coec.service.records.history import PairHistory
from coec.service.records.incidents import Incidents
from coec.service.records.state_store import StateStore


def state_of(remembered: Any) -> PairState:
    """The state; the first versions returned it beside other things."""
    state = getattr(remembered, "state", remembered)
    return state if isinstance(state, PairState) else remembered[0]


def books_of(folder: Path, pair: str, remembered: Any) -> Any:
    history: Any = PairHistory
    if "pair" in inspect.signature(PairHistory).parameters:
        return history(folder, pair, 1000, getattr(remembered, "history_heads", {}))
    return history(folder / f"history-{pair}.jsonl", 1000, getattr(remembered, "history_head", None))


def pair_read(store: StateStore, folder: Path, name: str, rig_document: Any) -> dict[str, Any]:
    try:
        remembered = store.load(rig_from_json(rig_document, None))
    except Exception as error:  # whatever an old version raises is what is to be told
        return {"error": f"{type(error).__name__}: {error}"}
    if remembered is None:
        return {"error": "nothing is remembered"}
    state = lifecycle.restored(state_of(remembered))
    books = books_of(folder, name, remembered)
    hold = getattr(state, "hold", None)
    return {
        "T_camera_lidar": state.T_camera_lidar.tolist(),
        "provenance": state.provenance.value,
        "is_held": bool(getattr(state, "frozen", False)) or hold is not None,
        "hold": None if hold is None else [hold.sender, hold.reason],
        "health": state.health.value,
        "accepted": state.accepted is not None,
        "evidence": state.monitor.evidence,
        "damage": books.damage,
        "history": [kept.entry.text for kept in books.entries()],
        "results": len(books.results()),
        "windows_of_events": sorted(Incidents(folder / "evidence", name, 4).window_ids),
    }


def read(folder: Path, expected: dict[str, Any]) -> dict[str, Any]:
    store = StateStore(folder, "shuttle-7")
    told: dict[str, Any] = {
        "damage": list(store.damage),
        "pairs": {name: pair_read(store, folder, name, pair["rig"]) for name, pair in expected["pairs"].items()},
    }
    try:
        told["baseline"] = load_baseline(folder / BASELINES, "front") is not None
    except Exception as error:  # likewise
        told["baseline"] = f"{type(error).__name__}: {error}"
    return told


if __name__ == "__main__":
    print(json.dumps(read(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")))))
