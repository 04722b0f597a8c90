"""Stand-ins for what lies outside: a worker process with chosen faults. Run as a program, this file is that worker."""

from __future__ import annotations

import os
import signal
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack

from coec.service.worker.child_process import Link

RESULT_FILE = "result.msgpack"
"""File in the fake worker's folder: a `CalibrationResult`, the answer to every window but for the window's id."""

SETTINGS_FILE = "settings"
"""File in the fake worker's folder: a line for each configuration that it was told, behind the id of its process."""

RELEASE_FILE = "let-go"
"""File in the fake worker's folder: a worker that is `late`, or compiles, waits for it."""


def wait_until(condition: Callable[[], bool], what: str, timeout_s: float = 20.0) -> None:
    """Return as soon as `condition` holds; fail with `what` after `timeout_s`. It is asked again and again, as it is of
    threads and processes that tell nobody."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise AssertionError(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.005)


def fake_worker_command(fault: str, folder: Path, at: str = "solve") -> list[str]:
    """Command of a worker that answers every question as documented, except for one fault.

    Args:
        fault: `none`; `compiling` (says that it compiles kernels, until it is let go, before it is ready),
            `compiling-stuck` (reports no progress after the first), `compiling-later` (after it is ready, when it is
            sent to); `unusable`, `stillborn`, `dumb` (says nonsense): at the start; `babble` (says something that
            nobody asked) or `deaf` (reads nothing more): as soon as it is ready; else a key of `FAULTS`, done at every
            question of the kind `at`. With the suffix `-once`, only by the first process that comes to it.
        folder: where it finds `RESULT` and remembers that it has done its fault.
        at: a kind of question.
    """
    return [sys.executable, __file__, fault, at, str(folder)]


def _answer(folder: Path, request: dict[str, Any]) -> Any:
    """Packed by hand, after what `coec.service.worker.worker_jobs` documents. A commissioning takes a slice for each of
    its windows, and one more."""
    match request["kind"]:
        case "prefetch":
            result: Any = None
        case "solve":
            estimate = msgpack.unpackb((folder / RESULT_FILE).read_bytes())
            estimate["window_id"] = Path(request["path"]).stem
            result = {"result": msgpack.packb(estimate), "note": None, "written": None}
        case "check":
            result = {"observation": _OBSERVATION, "baseline_not_used": f"{len(request['frames'])} pairs"}
        case "overlay":
            result = {"jpeg": request["title"].encode()}
        case "commission" if (done := _SLICES_DONE.get(request["run"], 0)) < len(request["paths"]):
            _SLICES_DONE[request["run"]] = done + 1
            underway = {"stage": "windows", "done": done + 1, "total": len(request["paths"])}
            return {"id": request["id"], "underway": underway}
        case _:
            pose = _array([4, 4], [float(value) for row in request["pose"] for value in row])
            result = {"pose": pose, "baseline_hash": "b" * 16, "windows": len(request["paths"]), "pairs": 7}
    return {"id": request["id"], "result": result}


_SLICES_DONE: dict[int, int] = {}
"""Slices that were done, by the number of the commissioning."""


def _array(shape: list[int], values: list[float]) -> msgpack.ExtType:
    return msgpack.ExtType(1, msgpack.packb([shape, struct.pack(f"<{len(values)}d", *values)]))


_OBSERVATION = {
    "stamp_ns": 7,
    "pair_stamps_ns": [5, 7],
    "metrics": [{"name": "mi", "value": 0.5, "limit": 0.1, "at_least": True}],
    "offset": _array([6], [0.25, 0.0, 0.0, 0.0, 0.0, float("nan")]),
    "sigma": _array([6], [0.5] * 6),
    "noise": _array([6], [0.4] * 6),
    "place": _array([6], [0.3] * 6),
    "dispersion": 1.0,
    "distance2": 0.125,
    "flagged": False,
    "weak": False,
    "flagged_by_paper": None,
    "causes": [],
    "first_derivative": _array([6], [0.0] * 6),
    "second_derivative": _array([6], [0.0] * 6),
    "drift": None,
    "dirty": [],
    "textured": 0,
}


def _crash(*_: object) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _hang(*_: object) -> None:
    signal.pause()


def _drop(*_: object) -> None:
    """Goes on to the next question."""


def _grow(*_: object) -> None:
    hoard = []
    while True:
        hoard.append(bytearray(b"x" * 2**24))


def _compile(link: Link, right: dict[str, Any], folder: Path) -> None:
    link.send({"kind": "compiling", "done": 0, "total": 3})
    wait_until((folder / RELEASE_FILE).exists, "the word to go on", 60.0)
    link.send({"kind": "compiled"})
    link.send(right)


def _half(*_: object) -> None:
    os.write(int(sys.argv[-2]), b"\0\0\1\0half")
    signal.pause()


def _half_and_die(*_: object) -> None:
    os.write(int(sys.argv[-2]), b"\0\0\1\0half")
    _crash()


def _noise(*_: object) -> None:
    os.write(int(sys.argv[-2]), b"\0\0\0\1\xc1\0\0\0\0")


def _huge(link: Link, right: dict[str, Any], folder: Path) -> None:
    del folder
    link.send({**right, "result": {"jpeg": bytes(2**26 + 1)}})


def _twice(link: Link, right: dict[str, Any], folder: Path) -> None:
    del folder
    link.send(right)
    link.send(right)


def _leave(link: Link, right: dict[str, Any], folder: Path) -> None:
    del folder
    link.send(right)
    sys.exit(0)


def _late(link: Link, right: dict[str, Any], folder: Path) -> None:
    wait_until((folder / RELEASE_FILE).exists, "the word to go on", 60.0)
    link.send(right)


def _instead(wrong: Callable[[dict[str, Any]], dict[str, Any]]) -> Callable[[Link, dict[str, Any], Path], None]:
    return lambda link, right, _: link.send(wrong(right))


FAULTS: dict[str, Callable[[Link, dict[str, Any], Path], None]] = {
    "crash": _crash,
    "hang": _hang,
    "drop": _drop,
    "grow": _grow,
    "half": _half,
    "half-and-die": _half_and_die,
    "noise": _noise,
    "huge": _huge,
    "twice": _twice,
    "leave": _leave,
    "late": _late,
    "compiles": _compile,
    "refuse": _instead(lambda right: {"id": right["id"], "refused": {"code": "bad_window", "text": "empty"}}),
    "other": _instead(lambda right: {**right, "id": right["id"] + 1}),
    "empty": _instead(lambda _: {}),
    "no-number": _instead(lambda right: {**right, "id": str(right["id"])}),
    "both": _instead(lambda right: {**right, "refused": {"code": "bad_window", "text": "empty"}}),
    "neither": _instead(lambda right: {"id": right["id"]}),
    "list": _instead(lambda right: {"id": right["id"], "result": [1, 2]}),
    "other-kind": _instead(lambda right: {"id": right["id"], "result": {"code": "a", "text": "b"}}),
    "wrong-types": _instead(lambda right: {"id": right["id"], "result": dict.fromkeys(right["result"], 1.5)}),
    "missing": _instead(lambda right: {"id": right["id"], "result": dict(list(right["result"].items())[1:])}),
}


def _note_settings(folder: Path, start: dict[str, Any]) -> None:
    with (folder / SETTINGS_FILE).open("a") as stream:
        stream.write(f"{os.getpid()} {start['settings']}\n")


def _serve(fault: str, at: str, folder: Path, link: Link) -> None:
    once = fault.endswith("-once")
    fault, marker = fault.removesuffix("-once"), folder / "done"

    def at_fault() -> bool:
        wrong = not (once and marker.exists())
        marker.touch()
        return wrong

    _note_settings(folder, link.receive())
    match fault:
        case "compiling" if at_fault():
            for done in range(3):
                link.send({"kind": "compiling", "done": done, "total": 3})
                wait_until((folder / RELEASE_FILE).exists, "the word to go on", 60.0)
                link.send({"kind": "compiled"})
        case "compiling-stuck" if at_fault():
            link.send({"kind": "compiling", "done": 1, "total": 3})
            signal.pause()
        case "unusable":
            link.send({"kind": "unusable", "code": "bad_model", "text": "no such network"})
            return
        case "stillborn":
            sys.exit(3)
        case "dumb" if at_fault():
            link.send({"kind": "ready?"})
    steps = int(fault == "compiling-later")
    link.send({"kind": "ready", "more": steps > 0})
    if fault == "babble" and at_fault():
        link.send({"id": 1, "result": None})
    if fault == "deaf" and at_fault():
        signal.pause()
    while True:
        request = link.receive()
        if request["kind"] == "start":
            _note_settings(folder, request)
            link.send({"kind": "ready"})
            continue
        if request["kind"] == "warm_up":
            link.send({"kind": "compiling", "done": 2, "total": 3})
            wait_until((folder / RELEASE_FILE).exists, "the word to go on", 60.0)
            link.send({"kind": "compiled"})
            link.send({"kind": "warmed", "more": False})
            continue
        right = _answer(folder, request)
        if fault in FAULTS and request["kind"] == at and at_fault():
            FAULTS[fault](link, right, folder)
        else:
            link.send(right)


if __name__ == "__main__":
    try:
        _serve(sys.argv[1], sys.argv[2], Path(sys.argv[3]), Link(int(sys.argv[4])))
    except (EOFError, OSError):
        sys.exit(0)
