"""Limits the evidence that goes out over the vehicle's link to so many bytes a second in the long run, whoever asks."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping

from coec.adapters.zenoh.bus import Answer
from coec.config import UplinkConfig
from coec.errors import CoecError
from coec.schemas.keys import MAX_LENGTH

BURST_BYTES = MAX_LENGTH
"""How many bytes may go out at once after a rest: the largest possible answer."""


class UplinkBusyError(CoecError):
    """The uplink may carry nothing more for now."""

    reply_code = "uplink_busy"


class Uplink:
    """A bucket of bytes, filled at the configured rate. An answer may take more than the bucket holds; then nothing
    goes out until the debt is paid back, so that answers of any size keep to the rate. Safe to use from several
    threads."""

    def __init__(self, config: UplinkConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: a clock in seconds that never goes back."""
        self._clock = clock
        self._lock = threading.Lock()
        self._rate = config.evidence_bytes_per_s
        self._bytes = float(BURST_BYTES)
        self._at_s = clock()
        self._sent: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()

    def reconfigure(self, config: UplinkConfig) -> None:
        """Keeps to this rate from now on."""
        with self._lock:
            self._fill()
            self._rate = config.evidence_bytes_per_s

    @property
    def sent(self) -> Mapping[str, int]:
        """Bytes sent since the start, by what was asked for."""
        with self._lock:
            return dict(self._sent)

    @property
    def refused(self) -> Mapping[str, int]:
        """Number of refused answers since the start, by what was asked for."""
        with self._lock:
            return dict(self._refused)

    def metered(self, resource: str, make: Callable[[], Answer]) -> Answer:
        """Makes an answer, but only if it may go out.

        Raises:
            UplinkBusyError: it may not go out now; the message says how long to wait.
        """
        with self._lock:
            self._fill()
            if self._bytes <= 0.0:
                self._refused[resource] += 1
                wait_s = max(-self._bytes / self._rate, 0.1)
                raise UplinkBusyError(
                    f"{self._rate} bytes of evidence a second go out (`uplink.evidence_bytes_per_s`): ask again in "
                    f"{wait_s:.1f} s"
                )
        answer = make()
        with self._lock:
            self._bytes -= len(answer.payload)
            self._sent[resource] += len(answer.payload)
        return answer

    def _fill(self) -> None:
        now_s = self._clock()
        self._bytes = min(float(BURST_BYTES), self._bytes + (now_s - self._at_s) * self._rate)
        self._at_s = now_s
