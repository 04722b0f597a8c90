"""Logs on standard output, a line per record, as JSON or for people, and counters of losses that cannot flood the
log."""

import json
import logging
import sys
import threading
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Literal, TextIO

from coec.untrusted import json_printable, printable, printable_lines

Form = Literal["auto", "json", "human"]

_LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING, "error": logging.ERROR}


class JsonFormatter(logging.Formatter):
    """One JSON object per record: time (UTC), level, logger, message, then what `extra={"fields": …}` gave."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line; line breaks and control characters inside are escaped by JSON."""
        document: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        fields = getattr(record, "fields", None)
        if isinstance(fields, dict):
            document.update({key: value for key, value in fields.items() if key not in document})
        if record.exc_info:
            document["exception"] = self.formatException(record.exc_info)
        return json_printable(json.dumps(document, ensure_ascii=False, default=str))


class HumanFormatter(logging.Formatter):
    """For a person at a terminal: local time, level unless it is `info`, message, then the fields. Control characters
    are escaped, so that text from a sender cannot move the cursor or make a second line."""

    def format(self, record: logging.LogRecord) -> str:
        """The record as one line, with the traceback below it if there is one."""
        time = datetime.fromtimestamp(record.created, UTC).astimezone().strftime("%H:%M:%S.%f")[:-3]
        level = "" if record.levelno == logging.INFO else f"{record.levelname.lower()}: "
        fields = getattr(record, "fields", None)
        fields_text = "".join(f"  {key}={value}" for key, value in fields.items()) if isinstance(fields, dict) else ""
        line = printable(f"{time} {level}{record.getMessage()}{fields_text}", None)
        if not record.exc_info:
            return line
        return f"{line}\n{printable_lines(self.formatException(record.exc_info))}"


def configure(level: str, form: Form, stream: TextIO | None = None) -> None:
    """Send every log record of the process to `stream` (standard output by default). Call again to change it.

    Args:
        level: one of debug, info, warning, error.
        form: `auto` means `human` if the stream is a terminal, else JSON lines.
    """
    to = stream if stream is not None else sys.stdout
    human = form == "human" or (form == "auto" and to.isatty())
    handler = logging.StreamHandler(to)
    handler.setFormatter(HumanFormatter() if human else JsonFormatter())
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(_LEVELS[level])


LOST: Mapping[str, str] = MappingProxyType(
    {
        "attachment_malformed": "a message's attachment cannot be read; the message is used",
        "camera_info": "a CameraInfo cannot be used",
        "check_not_afforded": "checks were left out, because `budget.cores` does not suffice for them",
        "check_overtaken": "a check ended after another extrinsic was served, and says nothing of that one",
        "check_superseded": "checks were left out, because newer ones came while a window was being solved",
        "cloud_empty": "a cloud has no points",
        "cloud_shape": "the arrays of a cloud do not have the same length",
        "cloud_too_large": "a cloud has more points than `limits.max_points`",
        "correction_of_nothing": "the rig has a correction for a pair that has no accepted estimate",
        "decoder_fault": "a decoder failed on a message, which is a fault of coec; the log has the traceback",
        "depth_missing": "a frame has no depth map, but `calibration.depth` wants one",
        "depth_not_grey": "a depth map is no 16-bit grey image",
        "frame_id": "a frame has another frame id than the configuration",
        "frame_id_invalid": "a message has no frame id that can be used",
        "image_corrupt": "an image cannot be decoded",
        "image_size": "an image has another size than the intrinsics",
        "image_size_mismatch": "an image has another size than its message says",
        "image_too_large": "an image has more pixels than `limits.max_image_pixels`",
        "image_truncated": "an image ends before its last row",
        "memory_full": "a frame was refused, because too many frames wait; the machine is too slow for the streams",
        "message_fields": "a message lacks fields, or has fields of other types",
        "message_malformed": "a message cannot be decoded",
        "message_too_large": "a message is larger than `limits.max_message_bytes`",
        "motion_invalid": "an ego-motion is not finite",
        "not_awaited": "frames were used before the answer that was due, because the worker cannot keep up with the "
        "streams; they are as good as any, but a replay may decide otherwise",
        "overrun": "messages were dropped before they were decoded, because too many wait",
        "recorder_overrun": "pairs were not recorded, because the disk is too slow",
        "sequence_gap": "messages were lost on their way here, by the numbers of the sender",
        "snippet_overrun": "a recording of an event was left out, because the disk is too slow",
        "stamp_invalid": "a message has a stamp that cannot be used",
        "too_few_pairs": "a window ended with too few pairs for a solve",
        "too_few_pairs_salvaged": "a window of an earlier run has too few pairs for a solve",
        "transform_invalid": "a transform is not finite, or no rotation",
        "transforms_too_many": "there are more transforms than can be kept",
        "two_senders": "frames are refused, because two publishers send on one topic at the same time",
        "uncalibrated": "a CameraInfo is empty (K is zero), after one that was not",
        "unanswered": "an answer of the worker did not come in time",
        "wrong_type": "a message is of another type than the stream's",
    }
)
"""What was lost, by the reason under which it is counted; for losses that are counted without a sentence."""


def loss_text(place: str, reason: str, detail: str = "") -> str:
    """The line of the log for a loss at a place."""
    return f"lost, {place}: {detail or LOST.get(reason) or reason.replace('_', ' ')}"


class LossCounter:
    """Counts losses by place and reason, and logs the first of each kind and then every 2^n-th.

    Reasons come from fixed sets, never from a sender. Safe to use from several threads.
    """

    def __init__(self, logger: logging.Logger, name: str, kind: str = "pair") -> None:
        """`name` identifies in the log the pair, or another `kind` of thing, whose losses these are."""
        self._logger = logger
        self._whose = {kind: name}
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()

    def add(self, place: str, reason: str, count: int = 1, detail: str = "") -> None:
        """Count `count` losses. `detail` is a sentence of the program; it must hold no text from the sender."""
        with self._lock:
            before = self._counts[place, reason]
            after = before + count
            self._counts[place, reason] = after
        if after.bit_length() != before.bit_length():
            fields = {**self._whose, "place": place, "reason": reason, "count": after}
            self._logger.warning(loss_text(place, reason, detail), extra={"fields": fields})

    def snapshot(self) -> dict[tuple[str, str], int]:
        """The counts so far: (place, reason) -> number."""
        with self._lock:
            return dict(self._counts)
