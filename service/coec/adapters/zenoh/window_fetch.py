"""Recorded windows, fetched over whatever link there is: piece by piece, resumed where it broke, verified at the end.

What has come lies beside the file, under a name that holds the sha256 it is to have: whoever asks again, with another
process on another day, goes on behind it, and pieces of two versions of a window never meet in one file.
"""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import zenoh

from coec.adapters.zenoh.client import ask_one
from coec.errors import CoecError, NotFoundError, OutputError, RemoteError
from coec.schemas.base import from_json
from coec.schemas.keys import Keys
from coec.schemas.replies import SnippetInfo, WindowInfo, WindowsReply

PIECE_BYTES: Final = 2**19
"""Asked for at once: half a second of the rate that a vehicle sends by default, and lost when the link breaks."""

MAX_WINDOW_BYTES: Final = 2**32
"""Of a window that is fetched: as much as a vehicle keeps of all by default (`state.max_bytes`)."""

DIGEST_POLL_S: Final = 0.2
"""Between questions whether the service has read a window: as often as its recorder looks for one."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""Before a piece is asked for again, doubled each time: the uplink fills at its rate, a link is back when it is."""

WAITS: Final = frozenset({"uplink_busy", "busy", "timeout"})
"""Codes of replies after which the same question may be answered."""

SHA256: Final = re.compile(r"[0-9a-f]{64}")
"""As the list writes it: a part of it becomes a part of a file's name."""

BLOCK_BYTES: Final = 2**20
"""Of what is there already, read at once to be hashed."""


Recording = WindowInfo | SnippetInfo


def fetch_window(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    window_id: str,
    path: Path,
    timeout_s: float,
    patience_s: float,
    heard: Callable[[int, int], None],
) -> Recording:
    """A window or snippet in a file that has its name only when its sha256 is right.

    A window that is rewritten on the way (its result came) is fetched once more. One that is there whole is not.

    Args:
        timeout_s: for one answer.
        patience_s: without any piece, before it is given up.
        heard: is told how many bytes are there, and of how many.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: no such window, or its bytes are not those that were promised.
        OutputError: the file cannot be written. What has come stays for the next attempt.
    """
    info = _digested(session, keys, pair, window_id, timeout_s)
    for attempt in (1, 2):
        if info.sha256 is None or not SHA256.fullmatch(info.sha256):
            raise RemoteError("malformed", f"the list does not say which sha256 window {window_id} has")
        if info.size_bytes > MAX_WINDOW_BYTES:
            raise RemoteError("too_large", f"window {window_id} is said to have {info.size_bytes} bytes: not fetched")
        try:
            if _is_there(path, info):
                heard(info.size_bytes, info.size_bytes)
                return info
            part = path.with_name(f"{path.name}.{info.sha256[:16]}.part")
            if _whole(session, keys.window(pair, window_id), info, part, timeout_s, patience_s, heard):
                part.replace(path)
                return info
            part.unlink()
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        renewed = _digested(session, keys, pair, window_id, timeout_s)
        if attempt == 2 or renewed.sha256 == info.sha256:
            break
        info = renewed
    raise RemoteError("checksum", f"the bytes of window {window_id} do not have the sha256 of the list; try again")


def _whole(
    session: zenoh.Session,
    key: str,
    info: Recording,
    part: Path,
    timeout_s: float,
    patience_s: float,
    heard: Callable[[int, int], None],
) -> bool:
    """Goes on with what is there until nothing is missing; False where it is not what was promised."""
    part.parent.mkdir(parents=True, exist_ok=True)
    with part.open("a+b") as file:
        if file.tell() > info.size_bytes:
            file.truncate(0)
        file.seek(0)
        digest, done = hashlib.sha256(), 0
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
            done += len(block)
        heard(done, info.size_bytes)
        while done < info.size_bytes:
            wanted = min(PIECE_BYTES, info.size_bytes - done)
            piece = _piece(session, f"{key}?offset={done};length={wanted}", timeout_s, patience_s)
            if not 0 < len(piece) <= wanted:
                return False
            file.write(piece)
            digest.update(piece)
            done += len(piece)
            heard(done, info.size_bytes)
    return digest.hexdigest() == info.sha256


def _piece(session: zenoh.Session, selector: str, timeout_s: float, patience_s: float) -> bytes:
    deadline_s, pause_s = time.monotonic() + patience_s, FIRST_PAUSE_S
    while True:
        try:
            return ask_one(session, selector, timeout_s).payload
        except CoecError as error:
            again = isinstance(error, NotFoundError) or error.reply_code in WAITS
            if not again or time.monotonic() + pause_s > deadline_s:
                raise
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)


def _is_there(path: Path, info: Recording) -> bool:
    if not path.is_file() or path.stat().st_size != info.size_bytes:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == info.sha256


def _digested(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> Recording:
    """What the list says of a window; the service may still be reading it."""
    deadline_s = time.monotonic() + timeout_s
    while (info := _info(session, keys, pair, window_id, timeout_s)).sha256 is None:
        if time.monotonic() > deadline_s:
            text = f"the service has not read window {window_id} since its start: try again in a minute"
            raise RemoteError("checksum", text)
        time.sleep(DIGEST_POLL_S)
    return info


def _info(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> Recording:
    reply = from_json(WindowsReply, ask_one(session, f"{keys.windows(pair)}?format=json", timeout_s).payload)
    recorded: dict[str, Recording] = {
        **{info.window_id: info for info in reply.windows},
        **{info.snippet_id: info for info in reply.snippets},
    }
    if window_id in recorded:
        return recorded[window_id]
    raise RemoteError("not_found", f"pair {pair} has no window {window_id}: see `coec query windows`")
