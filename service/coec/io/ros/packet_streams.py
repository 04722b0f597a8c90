"""Packets of a LiDAR on a topic, and the sweeps that they make up: of a bag (`PacketStream`), or as they come
(`PacketAssembler`). Both group them by the number of the turn in each.

The index of a bag keeps the beginning of each packet. What a packet means is known only after the whole bag was read,
because what the sensor says of itself (its metadata) may come late.

A sensor that is not synchronised counts from its own start. Its times are moved to the clock of the recorder: a packet
comes late by as much as network and driver need, never before its end, so that the one that came soonest within some
seconds ties the two clocks; over longer times, clocks of oscillators drift apart.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from coec.calibration.types import LidarFrame, Matrix4, Recognition
from coec.errors import DecodeError
from coec.io.frame_validation import Refusal
from coec.io.ros import hesai_packets, messages, ouster_packets, robosense_packets

MAX_DESCRIPTION_BYTES: Final = 2**20
"""Longest text in which a sensor says what it is; Ouster's has some 10 kB."""

MAX_PACKETS: Final = 8192
"""Most messages of a sweep: as many as a turn may have columns."""

MAX_SWEEP_BYTES: Final = ouster_packets.MAX_SWEEP_BYTES
"""Most bytes of the messages of a sweep that is not complete."""

NEIGHBOURS: Final = 100
"""Sweeps before and after a sweep by which its clock is tied to the recorder's: 10 s each at 10 Hz."""

SET_S: Final = 1_262_304_000
"""Begin of 2010, seconds since 1970. An earlier clock was never set: some sensors begin at 2000."""

RESTART_NS: Final = 1_000_000_000
"""Clocks that differ by more from one sweep to another are those of different starts of the sensor."""

WHOLE: Final = 0.9
"""Share of the usual number of packets that the first and the last sweep have at least, or are left out: the recorder
started or ended within them."""


class PacketSensor(Protocol):
    """A sensor whose packets are read; see `ouster_packets.OusterSensor`."""

    @property
    def name(self) -> str:
        """Maker and model, for people."""

    @property
    def frame_id(self) -> str:
        """Frame of the points, if nobody names another one."""

    @property
    def pose(self) -> tuple[str, Matrix4] | None:
        """A frame, and the pose (4, 4) of `frame_id` in it."""

    @property
    def notes(self) -> tuple[Recognition, ...]:
        """What is to be said of the points."""

    def heads(self, glimpses: Sequence[bytes]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """(N, 2) first and last time of each message by the sensor's clock, ns, and (N,) number of its sweep, -1 for
        something else, -2 for what the sensor sends beside points."""

    def sweep(self, payloads: Sequence[bytes], at_ns: int, stamp_ns: int) -> LidarFrame:
        """The points of some messages; `at_ns` by the sensor's clock is `stamp_ns` of the recording."""


class PacketFormat(Protocol):
    """The packets of a maker: a module, as `ouster_packets`."""

    @property
    def DESCRIBED(self) -> bytes:
        """What a text has in which its sensors say what they are."""

    def glimpse(self, payload: bytes) -> bytes:
        """What the index keeps of a message."""

    def sensor_of(self, glimpses: Sequence[bytes], description: bytes | None, /) -> PacketSensor:
        """The sensor that sent some messages."""


FORMATS: Final[Mapping[str, PacketFormat]] = {
    **dict.fromkeys(messages.OUSTER_PACKETS, ouster_packets),
    **dict.fromkeys(messages.HESAI, hesai_packets),
    messages.ROBOSENSE_PACKET: robosense_packets,
}
"""By the type of the messages that are read."""

TYPES: Final = tuple(FORMATS)


def is_description(data: bytes) -> bool:
    """Whether a message of text or bytes is one in which a sensor says what it is."""
    begin = data[:MAX_DESCRIPTION_BYTES]
    return any(of_maker.DESCRIBED in begin for of_maker in FORMATS.values())


def description_name(topic: str, text: bytes, known: Mapping[str, bytes]) -> str:
    """The name of a message in which a sensor says what it is: its topic; with a number if it is another correction
    file than those that came there, because two sensors then publish on the topic. An Ouster that starts again says
    something else of itself, and the last one holds."""
    if hesai_packets.DESCRIBED not in text[:MAX_DESCRIPTION_BYTES]:
        return topic
    names = (topic, *(f"{topic}#{number}" for number in range(2, len(known) + 2)))
    return next(name for name in names if known.get(name, text) == text)


@dataclass(frozen=True, slots=True, eq=False)
class PacketSweep:
    """The messages of a sweep. It is stamped in its middle.

    Attributes:
        middle_ns, stamp_ns: its middle, by the sensor's clock and by that of the recording.
        logged_ns: when the recorder got the message in its middle.
        places: where the messages lie.
    """

    sensor: PacketSensor
    middle_ns: int
    stamp_ns: int
    logged_ns: int
    places: tuple[tuple[int, ...], ...]

    def load(self, read: Callable[[tuple[int, ...]], bytes]) -> LidarFrame:
        """The sweep.

        Raises:
            DecodeError: the messages hold no points.
        """
        return self.sensor.sweep([read(place) for place in self.places], self.middle_ns, self.stamp_ns)


@dataclass(slots=True)
class PacketStream:
    """The messages on a topic of packets, in the order in the bag.

    Attributes:
        topic, type_name: where they came, and their type.
        damaged: how many were no such messages; `error`: why the last one was not.
    """

    topic: str
    type_name: str
    places: list[tuple[int, ...]] = field(default_factory=list)
    glimpses: list[bytes] = field(default_factory=list)
    logged_ns: array[int] = field(default_factory=lambda: array("q"))
    damaged: int = 0
    error: DecodeError | None = None

    def add(self, payload: bytes, place: tuple[int, ...], logged_ns: int) -> None:
        """Notes a message."""
        try:
            self.glimpses.append(FORMATS[self.type_name].glimpse(payload))
        except DecodeError as error:
            self.damaged, self.error = self.damaged + 1, error
            return
        self.places.append(place)
        self.logged_ns.append(logged_ns)

    def sensor(self, descriptions: Mapping[str, bytes], given: bytes | str | None) -> PacketSensor:
        """The sensor.

        Args:
            descriptions: messages in which sensors say what they are, by topic.
            given: such a text, or its topic, if a person says so.

        Raises:
            DecodeError: nothing says what it is, or several; or its packets are not read.
        """
        if not self.glimpses:
            raise self.error or DecodeError(Refusal.MESSAGE_MALFORMED, "there are no packets")
        of_maker = FORMATS[self.type_name]
        if isinstance(given, bytes):
            return of_maker.sensor_of(self.glimpses, given)
        known = {topic: text for topic, text in descriptions.items() if of_maker.DESCRIBED in text}
        adjacent = [name for name in known if name.rpartition("/")[0] == self.topic.rpartition("/")[0]]
        selected = [given] if given is not None else adjacent or list(known)
        if len(selected) > 1:
            text = f"several messages say what the LiDAR is, {', '.join(selected)}: choose with ?metadata=/TOPIC"
            raise DecodeError(Refusal.MESSAGE_TYPE, text)
        return of_maker.sensor_of(self.glimpses, known.get(selected[0]) if selected else None)

    def sweeps(self, sensor: PacketSensor) -> tuple[list[PacketSweep], tuple[Recognition, ...]]:
        """The sweeps, and what to tell of them.

        Raises:
            DecodeError: the messages are not of this sensor.
        """
        times_ns, numbers = sensor.heads(self.glimpses)
        groups = [np.array(group) for group in _grouped(numbers)]
        if not groups:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "no message has packets of points of this sensor")
        usual = float(np.median([len(group) for group in groups]))
        for end in (0, -1):
            if len(groups) > 1 and len(groups[end]) < WHOLE * usual:
                del groups[end]
        middles_ns = np.array([_middle(times_ns[group]) for group in groups])
        logged_ns = np.frombuffer(self.logged_ns, np.int64)[[group[len(group) // 2] for group in groups]]
        stamps_ns, notes = middles_ns, sensor.notes
        if np.median(middles_ns) < SET_S * 1e9:
            received_ns = np.frombuffer(self.logged_ns, np.int64)
            lags_ns = [_lag_ns(received_ns[group], times_ns[group]) for group in groups]
            stamps_ns = middles_ns + _ahead_ns(np.array(lags_ns))
            notes = (*notes, _FREE_RUNNING)
        other = int((numbers == -1).sum())
        if other or self.damaged:
            text = (
                f"Of {len(numbers) + self.damaged} messages of the LiDAR, {other} have packets in another form than "
                f"those of points, and {self.damaged} are damaged: left out."
            )
            notes = (*notes, Recognition("packets_left_out", text, "warn"))
        times = (middles_ns.tolist(), stamps_ns.tolist(), logged_ns.tolist())
        sweeps = [
            PacketSweep(sensor, middle, stamp, logged, tuple(self.places[index] for index in group))
            for group, middle, stamp, logged in zip(groups, *times, strict=True)
        ]
        return sweeps, notes


_FREE_RUNNING: Final = Recognition(
    "lidar_clock",
    "The LiDAR's clock counts from its start. Its sweeps are stamped by the times at which their packets were "
    "received, so that they may be late by the least delay of network and driver: synchronise it (PTP), or say "
    "?lidar_offset=S of a recording.",
    "warn",
)


def _grouped(numbers: NDArray[np.int64]) -> list[list[int]]:
    """Indices of the messages of each sweep. A message may come late, among those of the next sweep; numbers repeat
    after a while, and after a restart."""
    groups: list[list[int]] = []
    of_group: list[int] = []
    for index, number in enumerate(numbers.tolist()):
        if number < 0:
            continue
        for back in range(1, min(2, len(groups)) + 1):
            if of_group[-back] == number and len(groups[-back]) < MAX_PACKETS:
                groups[-back].append(index)
                break
        else:
            groups.append([index])
            of_group.append(number)
    return groups


def _lag_ns(received_ns: NDArray[np.int64], times_ns: NDArray[np.int64]) -> int:
    """Least time from the end of a message of a sweep until it was received: of (N,) times of receipt, and (N, 2) of
    the sensor. One of which only the first time is known lasts until the next one."""
    lasts_ns = int(np.median(times_ns[1:, 0] - times_ns[:-1, 1])) if len(times_ns) > 1 else 0
    return int((received_ns - times_ns[:, 1]).min()) - lasts_ns


def _middle(times_ns: NDArray[np.int64]) -> int:
    """Between the first and the last time; columns that were not measured may have none."""
    known_ns = times_ns[times_ns > 0]
    return int(known_ns.min() + np.ptp(known_ns) // 2) if len(known_ns) else 0


def _ahead_ns(lags_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) by how much the recorder's clock is ahead of the sensor's at each sweep, from the (N,) lags of receipt."""
    ahead_ns = lags_ns.copy()
    for shift in range(1, min(NEIGHBOURS, len(lags_ns) - 1) + 1):
        for at, near in ((slice(shift, None), slice(-shift)), (slice(-shift), slice(shift, None))):
            same_start = np.abs(lags_ns[near] - lags_ns[at]) < RESTART_NS
            np.minimum(ahead_ns[at], lags_ns[near], out=ahead_ns[at], where=same_start)
    return ahead_ns


# --- live -------------------------------------------------------------------------------------------------------------

OVERTAKEN: Final = 8
"""A sweep ends once the next one has this part of its messages: until then, one that was overtaken may come."""


@dataclass(slots=True)
class _OpenSweep:
    """The messages of a sweep so far, and when each was received."""

    number: int
    messages: list[bytes] = field(default_factory=list)
    glimpses: list[bytes] = field(default_factory=list)
    received_ns: list[int] = field(default_factory=list)
    bytes: int = 0


class PacketAssembler:
    """Sweeps from messages of packets as they come. The first one is left out, because it may have begun earlier.

    Attributes:
        sensor: the sensor that sends; None until that is known.
    """

    def __init__(self, type_name: str) -> None:
        self.type_name = type_name
        self.sensor: PacketSensor | None = None
        self._format = FORMATS[type_name]
        self._descriptions: dict[str, bytes] = {}
        self._open: deque[_OpenSweep] = deque()
        self._number, self._last = 0, b""
        self._is_first = True
        self._lags_ns: deque[int] = deque(maxlen=NEIGHBOURS)

    @property
    def notes(self) -> tuple[Recognition, ...]:
        """What is to be said of the points."""
        notes = () if self.sensor is None else self.sensor.notes
        return (*notes, _FREE_RUNNING) if self._lags_ns else notes

    def describe(self, text: bytes) -> None:
        """A message came in which a sensor says what it is. One that differs from the last begins anew."""
        known = text in self._descriptions.values() or len(self._descriptions) > 1
        if self._format.DESCRIBED in text and not known:
            self._descriptions[description_name("", text, self._descriptions)] = text
            self.sensor, self._is_first = None, True
            self._open.clear()

    def add(self, message: bytes, received_ns: int) -> LidarFrame | None:
        """A message came. The sweep that it ends, if it ends one.

        Raises:
            DecodeError: `message_type`: nothing says what the sensor is, or it is not read; or the message, or the
                sweep that it ends, cannot be used.
        """
        glimpse = self._format.glimpse(message)
        if self.sensor is None and self._format.DESCRIBED in message:
            self.describe(message)
            return None
        if self.sensor is None:
            if len(self._descriptions) > 1:
                text = "several messages say what the LiDAR is: name the right one with lidar.metadata_topic, or give"
                raise DecodeError(Refusal.MESSAGE_TYPE, f"{text} lidar.metadata")
            self.sensor = self._format.sensor_of([glimpse], self._descriptions.get(""))
        before = [self._open[-1].glimpses[0], self._last] if self._open else []
        _, numbers = self.sensor.heads([*before, glimpse])
        if numbers[-1] == -1:
            raise DecodeError(Refusal.MESSAGE_MALFORMED, "packets in another form than those of points")
        if numbers[-1] < 0:
            return None
        # Some numbers count from the first message of a list, so that only differences mean something.
        number = self._number + int(numbers[-1] - numbers[-2]) if before else 0
        self._number, self._last = number, glimpse
        sweep = next((one for one in self._open if one.number == number), None)
        if sweep is None:
            sweep = _OpenSweep(number)
            self._open.append(sweep)
        if len(sweep.messages) == MAX_PACKETS or sweep.bytes + len(message) > MAX_SWEEP_BYTES:
            text = f"a sweep has at most {MAX_PACKETS} messages of packets with {MAX_SWEEP_BYTES} bytes"
            raise DecodeError(Refusal.CLOUD_TOO_LARGE, text)
        sweep.messages.append(message)
        sweep.glimpses.append(glimpse)
        sweep.received_ns.append(received_ns)
        sweep.bytes += len(message)
        oldest, newest = self._open[0], self._open[-1]
        is_over = len(self._open) > 1 and OVERTAKEN * len(newest.messages) >= len(oldest.messages)
        return self._finished(self.sensor) if is_over or len(self._open) > 2 else None

    def _finished(self, sensor: PacketSensor) -> LidarFrame | None:
        """The oldest sweep."""
        sweep, is_first = self._open.popleft(), self._is_first
        self._is_first = False
        if is_first:
            return None
        times_ns, _ = sensor.heads(sweep.glimpses)
        stamp_ns = middle_ns = _middle(times_ns)
        if middle_ns < SET_S * 1e9:
            lag_ns = _lag_ns(np.array(sweep.received_ns), times_ns)
            if self._lags_ns and abs(lag_ns - self._lags_ns[-1]) > RESTART_NS:
                self._lags_ns.clear()
            self._lags_ns.append(lag_ns)
            stamp_ns = middle_ns + min(self._lags_ns)
        return sensor.sweep(sweep.messages, middle_ns, stamp_ns)
