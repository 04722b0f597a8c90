"""Fetches recorded windows over slow or broken links: piece by piece, resumed after a break, verified at the end.

The received part lies beside the final file, under a name that holds the expected sha256. A later attempt, even by
another process on another day, goes on from there, and pieces of two versions of a window never mix in one file.
"""

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

import zenoh

from coec.errors import CoecError, NotFoundError, OutputError, RemoteError
from coec.io import storage
from coec.io.user_files import require_absent
from coec.io.zenoh.query_client import query_one
from coec.schemas.keys import Keys
from coec.schemas.message import from_json
from coec.schemas.replies import SnippetInfo, WindowInfo, WindowsReply

PIECE_BYTES: Final = 2**19
"""Size of a piece: half a second at the rate at which a vehicle sends by default. A broken link loses one piece."""

MAX_WINDOW_BYTES: Final = 2**32
"""Largest window that is fetched: as much as a vehicle keeps of all windows by default (`state.max_bytes`)."""

SPARE_BYTES: Final = 2**28
"""Room that a fetched window must leave on the disk, for what else is written there meanwhile."""

DIGEST_POLL_S: Final = 0.2
"""Pause between queries whether the service has read a window; its recorder looks for windows as often."""

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0
"""Pause before a piece is asked for again, doubled each time up to the longest."""

RETRIED_CODES: Final = frozenset({"uplink_busy", "busy", "timeout"})
"""Reply codes after which it makes sense to send the same query again."""

SHA256: Final = re.compile(r"[0-9a-f]{64}")
"""Form of a hash in the list, checked because a part of the hash becomes part of a file name."""

BLOCK_BYTES: Final = 2**20
"""Bytes of the part that is already there to read and hash at a time."""


RecordingInfo = WindowInfo | SnippetInfo


class NoSpaceError(CoecError):
    """The disk has no room for a window that is to be fetched."""

    reply_code = "no_room"


def fetch_window(
    session: zenoh.Session,
    keys: Keys,
    pair: str,
    window_id: str,
    path: Path,
    timeout_s: float,
    patience_s: float,
    on_progress: Callable[[int, int], None],
    max_bytes: int = MAX_WINDOW_BYTES,
    *,
    replaces: bool = True,
) -> RecordingInfo:
    """Fetches a window or snippet into a file, which gets its final name only if its sha256 is right.

    If the service rewrites the window meanwhile (because its result came), it is fetched once more. A file that is
    already complete is not fetched.

    Args:
        timeout_s: for one answer.
        patience_s: time without any new piece after which to give up.
        heard: called with the number of bytes that are there, and the total.
        max_bytes: largest size that the vehicle may claim; nothing is fetched of a larger one.
        replaces: whether a file of another content may be replaced. An earlier version of the window is one.

    Raises:
        NotFoundError: nobody answered.
        RemoteError: there is no such window, it is larger than `max_bytes`, or its bytes do not have the promised hash.
        NoRoomError: the disk has no room for it.
        OutputError: the file cannot be written. The received part stays for the next attempt. Or it holds something
            else, and must not be replaced.
    """
    info = _digested(session, keys, pair, window_id, timeout_s)
    for attempt in (1, 2):
        if info.sha256 is None or not SHA256.fullmatch(info.sha256):
            raise RemoteError("malformed", f"the list does not say which sha256 window {window_id} has")
        if not 0 <= info.size_bytes <= max_bytes:
            text = f"window {window_id} is said to have {info.size_bytes} bytes, and {max_bytes} may be fetched"
            raise RemoteError("too_large", f"{text}: nothing of it was")
        try:
            if _is_complete(path, info):
                on_progress(info.size_bytes, info.size_bytes)
                return info
            require_absent(path, force=replaces)
            part = path.with_name(f"{path.name}.{info.sha256[:16]}.part")
            _require_space(part, info, window_id)
            if _complete(session, keys.window(pair, window_id), info, part, timeout_s, patience_s, on_progress):
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


def _complete(
    session: zenoh.Session,
    key: str,
    info: RecordingInfo,
    part: Path,
    timeout_s: float,
    patience_s: float,
    on_progress: Callable[[int, int], None],
) -> bool:
    """Completes the part that is there; False if the result does not have the promised hash."""
    with os.fdopen(storage.reopen(part), "a+b") as file:
        if file.tell() > info.size_bytes:
            file.truncate(0)
        file.seek(0)
        digest, done = hashlib.sha256(), 0
        while block := file.read(BLOCK_BYTES):
            digest.update(block)
            done += len(block)
        on_progress(done, info.size_bytes)
        while done < info.size_bytes:
            length = min(PIECE_BYTES, info.size_bytes - done)
            piece = _piece(session, f"{key}?offset={done};length={length}", timeout_s, patience_s)
            if len(piece) != length:
                return False
            file.write(piece)
            digest.update(piece)
            done += len(piece)
            on_progress(done, info.size_bytes)
    return digest.hexdigest() == info.sha256


def _require_space(part: Path, info: RecordingInfo, window_id: str) -> None:
    part.parent.mkdir(parents=True, exist_ok=True)
    missing = info.size_bytes - (part.stat().st_size if part.exists() else 0)
    free = shutil.disk_usage(part.parent).free
    if missing + SPARE_BYTES > free:
        raise NoSpaceError(
            f"no room for window {window_id} in {part.parent}: {missing} bytes are to be fetched, {free} are free, and "
            f"{SPARE_BYTES} of these stay free; make room, or name another place with --output"
        )


def _piece(session: zenoh.Session, selector: str, timeout_s: float, patience_s: float) -> bytes:
    deadline_s, pause_s = time.monotonic() + patience_s, FIRST_PAUSE_S
    while True:
        try:
            return query_one(session, selector, timeout_s).payload
        except CoecError as error:
            again = isinstance(error, NotFoundError) or error.reply_code in RETRIED_CODES
            if not again or time.monotonic() + pause_s > deadline_s:
                raise
        time.sleep(pause_s)
        pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)


def _is_complete(path: Path, info: RecordingInfo) -> bool:
    if not path.is_file() or path.stat().st_size != info.size_bytes:
        return False
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest() == info.sha256


def _digested(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> RecordingInfo:
    """The entry of a window in the service's list, once the service has read the window and knows its hash."""
    deadline_s = time.monotonic() + timeout_s
    while (info := _info(session, keys, pair, window_id, timeout_s)).sha256 is None:
        if time.monotonic() > deadline_s:
            text = f"the service has not read window {window_id} since its start: try again in a minute"
            raise RemoteError("checksum", text)
        time.sleep(DIGEST_POLL_S)
    return info


def _info(session: zenoh.Session, keys: Keys, pair: str, window_id: str, timeout_s: float) -> RecordingInfo:
    reply = from_json(WindowsReply, query_one(session, f"{keys.windows(pair)}?format=json", timeout_s).payload)
    recorded: dict[str, RecordingInfo] = {
        **{info.window_id: info for info in reply.windows},
        **{info.snippet_id: info for info in reply.snippets},
    }
    if window_id in recorded:
        return recorded[window_id]
    raise RemoteError("not_found", f"pair {pair} has no window {window_id}: see `coec query windows`")
