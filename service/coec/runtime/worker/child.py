"""One worker process, as the supervisor handles it: starts, watches, talks to and ends it. Every fault of the process
is a `ChildError`."""

from __future__ import annotations

import contextlib
import logging
import os
import subprocess
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Any

from coec.adapters.system.memory import resident_bytes
from coec.adapters.system.processor import processor_time_s
from coec.config import WorkerConfig
from coec.runtime.worker.link import Link, MalformedMessageError

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
        resident, allowed = self._resident_bytes(), self._config.max_memory_bytes
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
        """The next message of the process; to be called when it `has_spoken`.

        Raises:
            ChildError: the process has ended or stopped in the middle, or what came is no message.
        """
        try:
            return self._link.receive(MAX_ANSWER_BYTES)
        except MalformedMessageError as error:
            raise ChildError(Fault.MALFORMED_ANSWER, f"sent something that is not a message: {error}") from error
        except (OSError, EOFError) as error:
            raise self._broken(error) from error

    def kill(self) -> None:
        """Kills the process, whatever it is doing."""
        self._process.kill()
        try:
            self._process.wait(KILL_S)
        except subprocess.TimeoutExpired:
            _log.error("a killed worker does not end and is left behind", extra={"fields": {"pid": self.pid}})
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

    def _resident_bytes(self) -> int:
        """Resident memory of the process, bytes; 0 if it is gone."""
        return resident_bytes(self.pid)


def _environment(threads: int) -> dict[str, str]:
    inherited = os.environ.get("PYTHONPATH")
    path = os.pathsep.join([str(PACKAGE_ROOT), *([inherited] if inherited else [])])
    limits = {name: str(threads) for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS")}
    # All matrix products are (N, 3) by (3, 3): further threads would only spin, for longer than the work takes.
    limits["OPENBLAS_NUM_THREADS"] = "1"
    return {**os.environ, **limits, "PYTHONPATH": path}
