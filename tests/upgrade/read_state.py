"""Reads a state directory with the version of coec on PYTHONPATH, and prints what that version makes of it, as JSON.

    PYTHONPATH=service:tests python tests/upgrade/read_state.py STATE EXPECTED

EXPECTED is the file that `write_state` leaves beside the directory; it says of which rigs the state is.
"""

from __future__ import annotations

import inspect
import json
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

names = import_module(f"{__package__}.names" if __package__ else "names")
"""The file beside this one, which runs as a program, too."""

lifecycle = names.first_of("coec.calibration.state", "coec.calibration.lifecycle")
baseline_file = names.first_of("coec.io.baseline_file", "coec.adapters.files.baseline_file", "coec.io.rig_files")
rig_from_json = names.first_of("coec.io.rig_files:rig_from_json", "coec.adapters.files.rig:rig_from_json")
PairHistory = names.first_of("coec.service.records.history:PairHistory", "coec.runtime.decisions.history:History")
Incidents = names.first_of("coec.service.records.incidents:Incidents", "coec.runtime.decisions.incidents:Incidents")
StateStore = names.first_of(
    "coec.service.records.state_store:StateStore", "coec.runtime.decisions.state_store:StateStore"
)


def state_of(remembered: Any) -> Any:
    """The state; the first versions returned it beside other things."""
    state = getattr(remembered, "state", remembered)
    return state if isinstance(state, lifecycle.PairState) else remembered[0]


def books_of(folder: Path, pair: str, remembered: Any) -> Any:
    if "pair" in inspect.signature(PairHistory).parameters:
        return PairHistory(folder, pair, 1000, getattr(remembered, "history_heads", {}))
    return PairHistory(folder / f"history-{pair}.jsonl", 1000, getattr(remembered, "history_head", None))


def pair_read(store: Any, folder: Path, name: str, rig_document: Any) -> dict[str, Any]:
    load = store.load if hasattr(store, "load") else store.recall
    try:
        remembered = load(rig_from_json(rig_document, None))
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
        "history": [retained.entry.text for retained in books.entries()],
        "results": len(books.results()),
        "windows_of_events": sorted(Incidents(folder / "evidence", name, 4).window_ids),
    }


def read(folder: Path, expected: dict[str, Any]) -> dict[str, Any]:
    store = StateStore(folder, "shuttle-7")
    reported: dict[str, Any] = {
        "damage": list(store.damage),
        "pairs": {name: pair_read(store, folder, name, pair["rig"]) for name, pair in expected["pairs"].items()},
    }
    try:
        reported["baseline"] = baseline_file.load_baseline(folder / baseline_file.BASELINES, "front") is not None
    except Exception as error:  # likewise
        reported["baseline"] = f"{type(error).__name__}: {error}"
    return reported


if __name__ == "__main__":
    print(json.dumps(read(Path(sys.argv[1]), json.loads(Path(sys.argv[2]).read_text(encoding="utf-8")))))
