"""Packets of a LiDAR that come as messages: the sweeps of a recording of them, and what is lost counted."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from coec.calibration.types import LidarFrame
from coec.config import LidarConfig, LimitsConfig
from coec.io.logs import LossCounter
from coec.io.recordings.bag_index import CloudDecoder, build_index
from coec.io.recordings.bag_storage import open_storage
from coec.io.ros import message_decoding, messages
from coec.io.ros.wire_format import MessageAttachment
from coec.io.zenoh.bus import CDR, InputSample, input_of
from coec.service.discovery_listener import DiscoveryListener
from coec.service.ingest.decoder import LIDAR, Decoder, SampleReader
from support.packets import (
    HESAI,
    OUSTER,
    ROBOSENSE,
    RS_32,
    STRING,
    XT32,
    Entry,
    Ouster,
    bytes_message,
    correction_file,
    hesai_message,
    ouster_message,
    robosense_message,
    string_message,
    write_entries,
)
from support.pending_pairs import CAMERA, INFO, SAMPLES, TF_STATIC, configured
from support.recordings import STORE, T_BASE_LIDAR, transform_message
from support.ros import velodyne_scan

SECOND_NS, SWEEP_NS, TURNS = 10**9, 100_000_000, 6
BEGIN_NS = 1_700_000_000 * SECOND_NS
SENSOR = Ouster()
DIRECTIONS = ([16.0 - 1.1 * laser for laser in range(32)], [0.5] * 32)


@dataclass(frozen=True)
class Maker:
    """A LiDAR: its messages at 10 Hz with their times of receipt, and what it says of itself on another topic."""

    type_name: str
    sent: list[Entry]
    description: tuple[str, bytes] | None = None

    @property
    def entries(self) -> list[Entry]:
        described = [] if self.description is None else [(BEGIN_NS, "/top/metadata", *self.description)]
        return [*described, *self.sent]


def ouster(sensor: Ouster = SENSOR, begin_ns: int = BEGIN_NS, late_ns: tuple[int, ...] = (300_000,)) -> Maker:
    sent: list[Entry] = []
    for index in range(TURNS):
        ranges = np.full((sensor.columns, len(sensor.altitudes)), 5000 + 100 * index)
        turn = sensor.packets(
            ranges, ranges // 100, begin_ns + index * SWEEP_NS, (65_533 + index) % 65_536, SWEEP_NS // sensor.columns
        )
        for number, packet in enumerate(turn, 1):
            received_ns = BEGIN_NS + index * SWEEP_NS + number * SWEEP_NS // 4 + late_ns[len(sent) % len(late_ns)]
            sent.append((received_ns, "/top/lidar_packets", OUSTER, ouster_message(packet)))
    return Maker(OUSTER, sent, (STRING, string_message(sensor.metadata())))


def hesai(*, corrected: bool = True) -> Maker:
    sent: list[Entry] = []
    for index in range(TURNS):
        units = np.full((64, 32), 1250 + 25 * index)
        turn = XT32.packets(units, units % 251, BEGIN_NS + index * SWEEP_NS, SWEEP_NS / 64)
        sent.append((BEGIN_NS + (index + 1) * SWEEP_NS, "/top/lidar_packets", HESAI, hesai_message(turn)))
    return Maker(HESAI, sent, (messages.BYTES, bytes_message(correction_file(*DIRECTIONS))) if corrected else None)


def robosense(*, flagged: bool = True) -> Maker:
    """With a packet of the directions now and then, whose content changes."""
    sent: list[Entry] = []
    for index in range(TURNS):
        units = np.full((48, 32), 1000 + 20 * index)
        turn = RS_32.packets(units, units % 251, BEGIN_NS + index * SWEEP_NS, SWEEP_NS / 48)
        difop = RS_32.difop()[:-1] + bytes([index])
        of_turn = [robosense_message(each, begin=flagged and each is turn[0]) for each in turn]
        of_turn.insert(index % len(of_turn), robosense_message(difop))
        sent += [(BEGIN_NS + (index + 1) * SWEEP_NS, "/top/lidar_packets", ROBOSENSE, one) for one in of_turn]
    return Maker(ROBOSENSE, sent)


MAKERS: dict[str, Callable[[], Maker]] = {
    "Ouster": ouster,
    "Ouster, LEGACY": lambda: ouster(Ouster("LEGACY")),
    "Hesai": hesai,
    "Hesai, nominal": lambda: hesai(corrected=False),
    "RoboSense": robosense,
    "RoboSense, no flags": lambda: robosense(flagged=False),
}


def recorded(folder: Path, maker: Maker) -> list[LidarFrame]:
    path = write_entries(folder / "drive.mcap", maker.entries)
    storage = open_storage(path)
    stream = build_index(storage, CloudDecoder()).streams["/top/lidar_packets"]
    with storage.open() as reader:
        return [one.packets.load(reader) for one in stream.locations if one.packets is not None]


def sample_of(entry: Entry, number: int = 1, sender: bytes = b"a" * 16) -> InputSample:
    received_ns, _, type_name, data = entry
    return InputSample(data, f"{CDR};{type_name}", MessageAttachment(number, received_ns, sender).packed)


def lidar(**given: object) -> LidarConfig:
    return LidarConfig.model_validate({"topic": "/top/lidar_packets", "frame_id": "os_lidar", **given})


def live(maker: Maker, **given: object) -> list[LidarFrame]:
    reader = SampleReader(LIDAR, lidar(**given), LimitsConfig())
    frames = [reader.frame(sample_of(entry)) for entry in maker.entries]
    return [frame for frame in frames if isinstance(frame, LidarFrame)]


class Sensor:
    """The decoder of a stream, and what it lost."""

    def __init__(self, **given: object) -> None:
        self.losses = LossCounter(logging.getLogger("test"), "top")
        self.decoder = Decoder(LIDAR, lidar(**given), LimitsConfig(), self.losses)

    def take(self, entries: list[Entry]) -> int:
        """Number of sweeps."""
        return sum(self.decoder.frame(sample_of(entry, number)) is not None for number, entry in enumerate(entries, 1))

    @property
    def lost(self) -> dict[str, int]:
        return {cause: count for (_, cause), count in self.losses.snapshot().items()}


@pytest.mark.fault("a LiDAR whose packets come on a live topic", "its sweeps are those of a recording, to the byte")
@pytest.mark.parametrize("name", MAKERS)
def test_live_packets_are_the_sweeps_of_a_recording_of_the_same_messages(tmp_path: Path, name: str) -> None:
    maker = MAKERS[name]()
    expected, sweeps = recorded(tmp_path, maker), live(maker)
    # Of the first, packets may be missing, and the last has not ended.
    assert len(sweeps) >= TURNS - 2
    for sweep, other in zip(sweeps, expected[1:], strict=False):
        assert (sweep.stamp_ns, sweep.frame_id, sweep.timed_by) == (other.stamp_ns, other.frame_id, other.timed_by)
        for field in ("xyz_m", "intensity", "ring", "time_offset_s"):
            np.testing.assert_array_equal(getattr(sweep, field), getattr(other, field))


def test_a_clock_that_counts_from_its_start_is_tied_to_the_time_of_receipt() -> None:
    sweeps = live(ouster(begin_ns=77 * SECOND_NS, late_ns=(5_000_000, 900_000, 700_000, 12_000_000)))
    late_s = [(sweep.stamp_ns - BEGIN_NS) * 1e-9 % 0.1 - 0.0375 for sweep in sweeps]
    np.testing.assert_allclose(late_s, 0.0007, atol=1e-6)


def test_late_lost_damaged_and_foreign_packets_are_counted() -> None:
    sent = ouster().entries
    sensor = Sensor()
    late = sent.pop(9)
    sent.insert(10, late)
    sent.insert(12, (*late[:3], ouster_message(bytes(600))))
    sent.insert(13, (*late[:3], late[3][:-40]))
    numbers = [number for number in range(1, len(sent) + 1) if number != 18]
    rest = [sample_of(sent[number - 1], number) for number in numbers]
    frames = [frame for frame in map(sensor.decoder.frame, rest) if frame is not None]
    assert [len(frame.xyz_m) for frame in frames if isinstance(frame, LidarFrame)] == [256, 256, 192, 256]
    assert sensor.lost == {"message_malformed": 2}
    for number in range(100, 140):
        sensor.decoder.frame(sample_of(sent[0], number))
    assert sensor.lost["sequence_gap"] > 1


@pytest.mark.fault(
    "a damaged scan of Velodyne's packets on a live topic", "it is counted by its cause; the next is taken"
)
def test_live_scans_of_velodyne_are_sweeps() -> None:
    pytest.importorskip("velodyne_decoder", reason="needs the extra velodyne")
    sensor = Sensor(frame_id="velodyne", type=messages.VELODYNE_SCAN)
    scan = velodyne_scan()
    frame = sensor.decoder.frame(sample_of((BEGIN_NS, "", messages.VELODYNE_SCAN, scan)))
    expected = message_decoding.decode(messages.VELODYNE_SCAN, scan, LimitsConfig())
    assert isinstance(frame, LidarFrame)
    assert isinstance(expected, LidarFrame)
    for field in ("stamp_ns", "frame_id", "xyz_m", "intensity", "ring", "time_offset_s"):
        np.testing.assert_array_equal(getattr(frame, field), getattr(expected, field))
    damaged = [scan[:-1], velodyne_scan(1, packet=bytes(1206)), velodyne_scan(0)]
    sent: list[Entry] = [(BEGIN_NS, "", messages.VELODYNE_SCAN, data) for data in (*damaged, scan)]
    assert [sensor.decoder.frame(sample_of(one, number)) is not None for number, one in enumerate(sent, 2)] == [
        *(False,) * 3,
        True,
    ]
    assert sum(sensor.lost.values()) == len(damaged)
    assert "decoder_fault" not in sensor.lost


@pytest.mark.fault("two LiDARs that send packets on one live topic", "their sweeps are refused: two publishers")
def test_two_publishers_of_packets_are_two_senders() -> None:
    sensor = Sensor()
    one, other = ouster(), ouster(begin_ns=BEGIN_NS + SWEEP_NS // 3)
    # The other turns with other numbers.
    shifted = [(*rest, data[:10] + b"\7" + data[11:]) for *rest, data in other.sent]
    sensor.decoder.frame(sample_of(one.entries[0]))
    taken = 0
    for number, (a, b) in enumerate(zip(one.sent * 3, shifted * 3, strict=True), 1):
        for sender, entry in ((b"a" * 16, a), (b"b" * 16, b)):
            taken += sensor.decoder.frame(sample_of(entry, number, sender)) is not None  # type: ignore[arg-type]
    assert sensor.decoder.contested
    assert sensor.lost["two_senders"] > taken


def test_what_is_missing_is_named_with_what_to_do(caplog: pytest.LogCaptureFixture, tmp_path: Path) -> None:
    sensor = Sensor()
    assert sensor.take(ouster().sent) == 0
    assert sensor.lost == {"message_type": 4 * TURNS}
    assert "lidar.metadata" in caplog.text
    (tmp_path / "os.json").write_bytes(SENSOR.metadata())
    assert Sensor(metadata=tmp_path / "os.json").take(ouster().sent) == TURNS - 2
    assert Sensor(metadata=tmp_path / "none.json").take(ouster().sent) == 0
    assert "cannot read lidar.metadata" in caplog.text
    elsewhere = LidarConfig(topic="/top/raw", frame_id="os_lidar")
    unexpected = Decoder(LIDAR, elsewhere, LimitsConfig(), sensor.losses)
    assert unexpected.frame(sample_of(ouster().sent[0])) is None
    assert f"lidar.type: {OUSTER}" in caplog.text
    typed = LidarConfig.model_validate({"topic": "/top/raw", "type": OUSTER})
    assert typed.metadata_topics == ("/top/metadata", "/top/lidar_corrections")
    unnamed = SampleReader(LIDAR, LidarConfig(topic="/top/lidar_packets"), LimitsConfig())
    with pytest.raises(Exception, match=r"set lidar\.type"):
        unnamed.frame(InputSample(ouster().sent[0][3], "zenoh/bytes"))


@pytest.mark.fault("two LiDARs whose correction files come on one topic", "refused until one is named")
def test_two_correction_files_are_refused_until_one_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    other = bytes_message(correction_file([one + 0.1 for one in DIRECTIONS[0]], DIRECTIONS[1]))
    entries = [(BEGIN_NS, "/top/lidar_corrections", messages.BYTES, other), *hesai().entries]
    assert Sensor(frame_id="hesai").take([entries[0], *hesai(corrected=False).sent]) == TURNS - 2
    sensor = Sensor(frame_id="hesai")
    assert sensor.take(entries) == 0
    assert sensor.lost == {"message_type": TURNS}
    assert "name the right one with lidar.metadata_topic" in caplog.text
    assert sensor.take([entries[0], entries[1]] * 10) == 0
    # Recorded on one topic.
    shared = [(time, "/top/lidar_corrections" if name == messages.BYTES else topic, name, data)
              for time, topic, name, data in entries]  # fmt: skip
    storage = open_storage(write_entries(tmp_path / "drive.mcap", [*shared, shared[0]]))
    unread = build_index(storage, CloudDecoder()).unread["/top/lidar_packets"]
    assert "several messages say what the LiDAR is, /top/lidar_corrections, /top/lidar_corrections#2" in unread
    named = build_index(storage, CloudDecoder(), "/top/lidar_corrections#2")
    assert len(named.streams["/top/lidar_packets"].locations) == TURNS


def test_a_sensor_that_is_set_otherwise_begins_anew() -> None:
    before, after = ouster(), ouster(Ouster("LEGACY"))
    sensor = Sensor()
    assert sensor.take(before.entries) == TURNS - 2
    assert sensor.take(after.entries) == TURNS - 2
    assert sensor.lost == {}


@pytest.mark.fault("packets whose messages claim gigabytes", "memory stays bounded, each counted")
def test_a_turn_that_never_ends_is_bounded() -> None:
    sensor = Sensor()
    head, first = ouster().entries[:2]
    sensor.decoder.frame(sample_of(head))
    assert sensor.take([first] * 9000) == 0
    assert sensor.lost["cloud_too_large"] == 9000 - 8192


@pytest.mark.parametrize("middleware", ["rmw_zenoh", "ros2dds"])
def test_the_topic_of_the_metadata_belongs_to_the_stream(tmp_path: Path, middleware: str) -> None:
    config = configured(tmp_path).model_copy(update={"middleware": middleware})
    keys = input_of(lidar(), config).described_on
    assert any("top/metadata" in key for key in keys)
    assert any("top/lidar_corrections" in key for key in keys)
    assert input_of(lidar(metadata_topic="/else/metadata"), config).described_on[0].count("else/metadata") == 1
    assert input_of(LidarConfig(topic="/top/points"), config).described_on == ()


@pytest.mark.fault("a pair whose LiDAR publishes packets only", "discovery names the model and what is missing")
@pytest.mark.parametrize(
    ("name", "child", "missing", "origin"),
    [
        ("Ouster", "os_sensor", "no metadata: .* lidar.metadata", "Ouster with 4 beams (RNG19_RFL8_SIG16_NIR16)"),
        ("RoboSense", "rslidar", "no DIFOP packet", "RoboSense RS-32"),
        ("Hesai, nominal", "hesai", "", "Hesai PandarXT-32. The packets of the LiDAR are read with the nominal"),
    ],
)
def test_discovery_names_the_sensor_and_what_it_lacks(
    tmp_path: Path, name: str, child: str, missing: str, origin: str
) -> None:
    watch = DiscoveryListener(configured(tmp_path, points="/top/lidar_packets"), {})
    maker = MAKERS[name]()
    tree = STORE.serialize_cdr(
        STORE.types[messages.TF]([transform_message("camera", "base", np.eye(4)),
                                  transform_message("base", child, T_BASE_LIDAR)]), messages.TF
    )  # fmt: skip
    watch.take_transforms(InputSample(bytes(tree), SAMPLES[TF_STATIC].encoding))
    watch.take_info("front", SAMPLES[INFO])
    watch.take_frame("front", "camera", SAMPLES[CAMERA])
    if missing:
        watch.take_frame("front", LIDAR, sample_of(maker.sent[1]))
        watch.update()
        (reason,) = watch.nominal("front").awaits
        assert re.search(missing, reason.text)
    for entry in maker.entries[:3]:
        watch.take_frame("front", LIDAR, sample_of(entry))
    watch.update()
    ready = watch.ready()["front"]
    assert ready.pair.lidar.frame_id == ("os_lidar" if name == "Ouster" else child)
    assert origin in ready.origins["lidar.frame_id"]
