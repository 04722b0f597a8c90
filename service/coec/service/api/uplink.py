"""What a vehicle sends over its uplink: the heartbeat of each pair, a short report that others can store, and
evidence, which is limited to so many bytes a second in the long run, whoever requests it. A heartbeat is published
when it changes, from time to time, and at the end.
"""

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from typing import Literal

from coec.config import UplinkConfig
from coec.errors import CoecError, NotFoundError
from coec.io.zenoh.bus import Answer
from coec.schemas.heartbeat import MAX_REASONS, MAX_TEXT, LastWord
from coec.schemas.keys import MAX_LENGTH, Format, Keys
from coec.schemas.replies import Maybe6, Vector6
from coec.service.api.pair_answers import PairAnswers, PendingPairAnswers
from coec.service.api.reply_builders import answer_of
from coec.service.timing import TokenBucket

ServiceState = Literal["starting", "running", "stopping", "failing"]


class Heartbeats:
    """The last words of one vehicle. `renew` and `reconfigure` are for the main thread, `answer` for any."""

    def __init__(
        self,
        keys: Keys,
        version: str,
        config: UplinkConfig,
        publish: Callable[[str, Answer], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`clock`: a clock in seconds that never goes back."""
        self._keys = keys
        self._version = version
        self._config = config
        self._publish = publish
        self._clock = clock
        self._latest: dict[str, LastWord] = {}
        self._published: dict[str, tuple[object, float]] = {}

    def reconfigure(self, config: UplinkConfig) -> None:
        """Publishes as often as this configuration says."""
        self._config = config

    def renew(
        self, service: ServiceState, config_hash: str, answering: Iterable[PairAnswers | PendingPairAnswers]
    ) -> None:
        """Makes the present word of each pair, and publishes it if it has changed or was not published for a period."""
        now_s = self._clock()
        for answers in answering:
            heartbeat = self._heartbeat_of(service, config_hash, answers)
            self._latest[heartbeat.pair] = heartbeat
            essence = _essence(heartbeat)
            before, published_s = self._published.get(heartbeat.pair, (None, 0.0))
            if essence != before or now_s - published_s >= self._config.last_word_s:
                self._published[heartbeat.pair] = (essence, now_s)
                self._publish(self._keys.last(heartbeat.pair), answer_of(heartbeat, "msgpack"))

    def answer(self, pair: str, form: Format) -> Answer:
        """The present word of a pair.

        Raises:
            NotFoundError: there is no such pair.
        """
        heartbeat = self._latest.get(pair)
        if heartbeat is None:
            raise NotFoundError("no pair of this name has reported anything")
        return answer_of(heartbeat, form)

    def _heartbeat_of(
        self, service: ServiceState, config_hash: str, answers: PairAnswers | PendingPairAnswers
    ) -> LastWord:
        health = answers.health_reply
        built = answers if isinstance(answers, PairAnswers) else None
        extrinsic = None if built is None else built.extrinsic_reply
        correction: Vector6 | None = None
        sigma: Maybe6 | None = None
        if extrinsic is not None:
            axes = extrinsic.axes
            six = (axes.rx, axes.ry, axes.rz, axes.tx, axes.ty, axes.tz)
            a, b, c, d, e, f = (axis.correction for axis in six)
            correction = (a, b, c, d, e, f)
            s, t, u, v, w, x = (axis.sigma for axis in six)
            sigma = (s, t, u, v, w, x)
        return LastWord(
            vehicle=health.vehicle,
            pair=health.pair,
            said_ns=time.time_ns(),
            period_s=self._config.last_word_s,
            service=service,
            version=self._version,
            config_hash=config_hash,
            state=health.state,
            level=health.level,
            reasons=tuple(
                reason.model_copy(update={"text": reason.text[:MAX_TEXT]}) for reason in health.reasons[:MAX_REASONS]
            ),
            since_ns=health.since_ns,
            age_s=health.age_s,
            drift=health.drift,
            drift_sigma=health.drift_sigma,
            provenance=None if extrinsic is None else extrinsic.provenance,
            status=None if extrinsic is None else extrinsic.status,
            correction=correction,
            sigma=sigma,
            held=extrinsic is not None and extrinsic.held,
            windows=0 if built is None else built.recorded,
            alarms=health.alarms,
            event=None if built is None else built.newest_event,
        )


def _essence(heartbeat: LastWord) -> object:
    """The part of a word whose change makes it published at once."""
    codes = tuple(reason.code for reason in heartbeat.reasons)
    served = (heartbeat.provenance, heartbeat.status, heartbeat.correction, heartbeat.held)
    return (
        heartbeat.service,
        heartbeat.config_hash,
        heartbeat.state,
        codes,
        heartbeat.since_ns,
        served,
        heartbeat.event,
    )


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
        self._bucket = TokenBucket(float(BURST_BYTES), clock())
        self._sent: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()

    def reconfigure(self, config: UplinkConfig) -> None:
        """Keeps to this rate from now on."""
        with self._lock:
            self._bucket.fill(self._clock(), self._rate)
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

    def admit(self, resource: str) -> None:
        """Lets an answer be made that may go out now; `count_sent` says of how many bytes.

        Raises:
            UplinkBusyError: it may not go out now; the message says how long to wait.
        """
        with self._lock:
            level = self._bucket.fill(self._clock(), self._rate)
            if level <= 0.0:
                self._refused[resource] += 1
                wait_s = max(-level / self._rate, 0.1)
                raise UplinkBusyError(
                    f"{self._rate} bytes of evidence a second go out (`uplink.evidence_bytes_per_s`): ask again in "
                    f"{wait_s:.1f} s"
                )

    def count_sent(self, resource: str, count: int) -> None:
        """Takes the bytes of an answer that goes out."""
        with self._lock:
            self._bucket.level -= count
            self._sent[resource] += count
