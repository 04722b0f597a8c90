"""One worker process, as the supervisor handles it: starts, watches, talks to and ends it; and what ties the two
processes together: the wire between them, and the child's death with its parent. Every fault of the process is a
`ChildError`.

The wire is one socket pair, with one msgpack map per message, sent in parts. A process that dies may leave half a
message. So sends and receives have a time limit, and neither end can block for ever on the other.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import socket
import struct
import subprocess
from collections.abc import Iterator, Sequence
from enum import StrEnum
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgpack

from coec.io.system import die_with_parent, processor_time_s, resident_bytes

if TYPE_CHECKING:
    from coec.config import WorkerConfig  # the other end of the wire, which has no use for it, starts in half the time

_BIN32 = struct.Struct(">BI")
_BIN32_CODE = 0xC6
"""Code of msgpack for a byte string with a length of 32 bits."""

LARGE_BYTES = 2**16
"""A byte string of at least this size is sent without being copied."""

END = b""
"""The part that ends a message."""

MAX_MESSAGE_BYTES = 2**30
"""Largest message, bytes. A frame is bounded by `LimitsConfig.max_message_bytes`, which is at most 1 GiB."""

TRANSFER_TIMEOUT_S = 10
"""Largest pause inside one transfer, s. The other end only has to read from its socket buffer."""


class MalformedMessageError(Exception):
    """What came over the wire is not a message; the text says why."""


class Link:
    """One end of the wire."""

    def __init__(self, descriptor: int) -> None:
        """Takes over the descriptor of a connected stream socket."""
        self._connection = Connection(descriptor)

    @classmethod
    def pair(cls) -> tuple[Link, socket.socket]:
        """A connected pair: our end, and the socket to hand to the child."""
        ours, theirs = socket.socketpair()
        limit = struct.pack("@ll", TRANSFER_TIMEOUT_S, 0)
        for option in (socket.SO_SNDTIMEO, socket.SO_RCVTIMEO):
            ours.setsockopt(socket.SOL_SOCKET, option, limit)
        return cls(ours.detach()), theirs

    def send(self, message: dict[str, Any]) -> None:
        """Sends one message.

        Raises:
            OSError: the other end is gone, or does not read.
        """
        for part in _parts(message):
            self._connection.send_bytes(part)
        self._connection.send_bytes(END)

    def poll(self, timeout_s: float) -> bool:
        """Whether a message, or the end of the stream, can be received within `timeout_s`."""
        return self._connection.poll(timeout_s)

    def receive(self, max_bytes: int = MAX_MESSAGE_BYTES) -> dict[str, Any]:
        """The next message, of at most `max_bytes`; blocks until it is there.

        Raises:
            MalformedMessageError: what came is too large, not msgpack, or no map.
            OSError, EOFError: the other end is gone, or stopped in the middle of a message.
        """
        unpacker = msgpack.Unpacker(max_buffer_size=max_bytes)
        while part := self._part(max_bytes):
            try:
                unpacker.feed(part)
            except msgpack.BufferFull:
                raise MalformedMessageError(f"it is larger than {max_bytes} bytes") from None
        try:
            message = unpacker.unpack()
        except (ValueError, msgpack.UnpackException) as error:
            raise MalformedMessageError(f"it is not msgpack ({type(error).__name__})") from error
        if not isinstance(message, dict):
            raise MalformedMessageError("it is not a map")
        return message

    def _part(self, max_bytes: int) -> bytes:
        try:
            return self._connection.recv_bytes(max_bytes)
        except OSError:
            if not self._connection.readable:  # the library sets this when a part is too large
                raise MalformedMessageError(f"it is larger than {max_bytes} bytes") from None
            raise

    def close(self) -> None:
        """Closes this end; the other end reads the end of the stream."""
        self._connection.close()


def _parts(message: dict[str, Any]) -> Iterator[bytes]:
    """The message in msgpack, piece by piece. A large byte string is a piece by itself and is not copied. Only one
    packed entry of a lazy sequence is in memory at a time."""
    packer = msgpack.Packer(autoreset=False)

    def taken() -> bytes:
        packed: bytes = packer.bytes()
        packer.reset()
        return packed

    def add(value: Any) -> Iterator[bytes]:
        if isinstance(value, dict):
            packer.pack_map_header(len(value))
            for key, entry in value.items():
                packer.pack(key)
                yield from add(entry)
        elif isinstance(value, Sequence) and not isinstance(value, str | bytes | msgpack.ExtType):
            packer.pack_array_header(len(value))
            for entry in value:
                yield from add(entry)
        elif isinstance(value, bytes) and len(value) >= LARGE_BYTES:
            yield taken() + _BIN32.pack(_BIN32_CODE, len(value))
            yield value
        else:
            packer.pack(value)

    yield from add(message)
    if rest := taken():  # empty after a large byte string, but an empty part would end the message
        yield rest


_log = logging.getLogger(__name__)

PACKAGE_ROOT = Path(__file__).resolve().parents[3]

MAX_ANSWER_BYTES = 2**26
"""Largest answer, bytes: a picture has some MB, every other answer some kB."""

EXIT_WAIT_S = 1.0
"""Time for a process that has broken its connection to end, s, so that its exit code can be reported."""

KILL_S = 5.0
"""Time for a killed process to end, s. It takes milliseconds, unless the process waits for a broken disk; then it is
left behind."""


class Fault(StrEnum):
    """Why a worker process is replaced."""

    NOT_STARTED = "not_started"
    UNUSABLE = "unusable"
    DIED = "died"
    TIMED_OUT = "timed_out"
    TOO_LARGE = "too_large"
    DISCONNECTED = "disconnected"
    STRAY_ANSWER = "stray_answer"
    MALFORMED_ANSWER = "malformed_answer"
    UNSENDABLE_JOB = "unsendable_job"


class ChildError(Exception):
    """The worker process has to be replaced. The message continues a sentence that begins with "The worker"."""

    def __init__(self, fault: Fault, text: str) -> None:
        super().__init__(text)
        self.fault = fault


class Child:
    """One worker process. `kill` must be called in the end."""

    def __init__(self, command: Sequence[str], config: WorkerConfig) -> None:
        """Starts `command`, with the descriptor of its socket and the id of this process as further arguments.

        Raises:
            ChildError: the process cannot be started.
        """
        self._config = config
        try:
            self._link, theirs = Link.pair()
        except OSError as error:
            raise ChildError(Fault.NOT_STARTED, f"could not be started: there is no socket for it ({error})") from error
        with theirs:
            try:
                self._process = subprocess.Popen(
                    [*command, str(theirs.fileno()), str(os.getpid())],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    env=_environment(config.threads),
                )
            except (OSError, subprocess.SubprocessError) as error:
                self._link.close()
                raise ChildError(Fault.NOT_STARTED, f"could not be started ({error})") from error
        self._cpu_s = self._reported_cpu_s = 0.0

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def watch(self) -> int:
        """Checks the process and returns its resident memory, bytes.

        Raises:
            ChildError: the process has ended, or is too large.
        """
        if (exit_text := self._exit_text()) is not None:
            raise ChildError(Fault.DIED, exit_text)
        self._read_processor_time()
        resident, allowed = resident_bytes(self.pid), self._config.max_memory_bytes
        if resident > allowed:
            text = f"used {resident >> 20} MiB of memory; worker.max_memory_bytes allows {allowed >> 20} MiB"
            raise ChildError(Fault.TOO_LARGE, text)
        return resident

    def taken_s(self) -> float:
        """Processor time since the last call, s. If the process has ended, up to when it was last watched."""
        self._read_processor_time()
        taken_s, self._reported_cpu_s = self._cpu_s - self._reported_cpu_s, self._cpu_s
        return taken_s

    def send(self, message: dict[str, Any]) -> None:
        """Sends a message.

        Raises:
            ChildError: the process has ended or does not read, or the message cannot be packed.
        """
        try:
            self._link.send(message)
        except OSError as error:
            raise self._broken(error) from error
        except Exception as error:  # from a lazy sequence; part of the message has already reached the worker
            _log.exception("a message for the worker could not be packed")
            text = f"could not be sent a message ({type(error).__name__}: {error})"
            raise ChildError(Fault.UNSENDABLE_JOB, text) from error

    def has_message(self, within_s: float) -> bool:
        """Whether a message, or the end of the connection, can be received within this time."""
        return self._link.poll(within_s)

    def receive(self) -> dict[str, Any]:
        """The next message of the process; to be called when it `has_message`.

        Raises:
            ChildError: the process has ended or stopped in the middle, or what came is no message.
        """
        try:
            return self._link.receive(MAX_ANSWER_BYTES)
        except MalformedMessageError as error:
            raise ChildError(Fault.MALFORMED_ANSWER, f"sent an invalid message: {error}") from error
        except (OSError, EOFError) as error:
            raise self._broken(error) from error

    def kill(self) -> None:
        """Kills the process, whatever it is doing."""
        self._process.kill()
        try:
            self._process.wait(KILL_S)
        except subprocess.TimeoutExpired:
            _log.error("a killed worker process does not exit and is abandoned", extra={"fields": {"pid": self.pid}})
        self._link.close()

    def _read_processor_time(self) -> None:
        with contextlib.suppress(OSError):
            self._cpu_s = processor_time_s(self.pid)

    def _broken(self, error: Exception) -> ChildError:
        """The fault behind a broken connection: how the process ended, if it did, because that tells more."""
        exit_text = self._exit_text(EXIT_WAIT_S)
        if exit_text is not None:
            return ChildError(Fault.DIED, exit_text)
        return ChildError(Fault.DISCONNECTED, f"broke the connection ({type(error).__name__})")

    def _exit_text(self, wait_s: float = 0.0) -> str | None:
        """How the process ended; None while it lives."""
        try:
            code = self._process.wait(wait_s)
        except subprocess.TimeoutExpired:
            return None
        return f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"


def _environment(threads: int) -> dict[str, str]:
    inherited = os.environ.get("PYTHONPATH")
    path = os.pathsep.join([str(PACKAGE_ROOT), *([inherited] if inherited else [])])
    limits = {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    # All matrix products are (N, 3) by (3, 3): further threads would only spin, for longer than the work takes.
    limits["OPENBLAS_NUM_THREADS"] = "1"
    return {**os.environ, **limits, "PYTHONPATH": path}


def tie_to(parent: int) -> None:
    """Lets this process die with the parent thread that started it, and ignore the signals of a terminal or a manager,
    which the parent handles."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    die_with_parent(parent)
