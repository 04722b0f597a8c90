"""What the vehicle's link carries of evidence: so many bytes a second in the long run, whoever asks for them."""

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
"""That may go out at once after a rest: the largest answer there is."""


class UplinkBusyError(CoecError):
    """What the uplink may carry is spent for now."""

    reply_code = "uplink_busy"


class Uplink:
    """A bucket of bytes, filled at the configured rate. An answer may take more than is in it: then nothing more goes
    out until that is paid back, so that answers of any size keep to the rate. Safe to use from several threads."""

    def __init__(self, config: UplinkConfig, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` tells seconds that never go back."""
        self._clock = clock
        self._lock = threading.Lock()
        self._rate = config.evidence_bytes_per_s
        self._bytes = float(BURST_BYTES)
        self._at_s = clock()
        self._sent: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()

    def use(self, config: UplinkConfig) -> None:
        """Keep to this rate from now on."""
        with self._lock:
            self._fill()
            self._rate = config.evidence_bytes_per_s

    @property
    def sent(self) -> Mapping[str, int]:
        """Bytes since the start, by what was asked for."""
        with self._lock:
            return dict(self._sent)

    @property
    def refused(self) -> Mapping[str, int]:
        """Answers since the start that had to wait, likewise."""
        with self._lock:
            return dict(self._refused)

    def metered(self, resource: str, make: Callable[[], Answer]) -> Answer:
        """An answer, made only when it may go out.

        Raises:
            UplinkBusyError: it may not now; says for how long.
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
