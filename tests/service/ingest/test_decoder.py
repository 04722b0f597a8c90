"""From samples to frames: the encoding chooses the decoder, what does not fit is counted, nothing is raised."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace

import numpy as np
import pytest

from coec.calibration.frames.message_evidence import MOST_CLOUDS
from coec.calibration.frames.pairing import Pairer
from coec.calibration.types import CameraFrame, EgoMotion, EncodedImage, Frame, ImageFormat, LidarFrame
from coec.config import (
    IDENTITY,
    CameraConfig,
    CameraIntrinsics,
    EgoConfig,
    LidarConfig,
    LimitsConfig,
    PairConfig,
    PairingConfig,
    PointTimeConfig,
)
from coec.io import msgpack_frames
from coec.io.logs import LossCounter
from coec.io.ros import message_encoding
from coec.io.zenoh.bus import InputSample
from coec.io.zenoh.ros_node import RosTopicList
from coec.service.api.problems import stream_problems
from coec.service.ingest.decoder import CAMERA, EGO, LIDAR, RECENT, Decoder, SensorStream
from coec.service.ingest.inbox import Inbox, Parcel, Posted
from support.ros import Packer, packed_cloud, transforms
from support.scenes import ROOF_POSE, sweep_in_frame, turning_sweep

MSGPACK, CDR = "application/msgpack", "application/cdr"
PAIR = PairConfig(
    name="front",
    camera=CameraConfig(
        key="c",
        type="sensor_msgs/msg/Image",
        intrinsics=CameraIntrinsics(model="pinhole", width=4, height=3, fx=1, fy=1, cx=1, cy=1),
    ),
    lidar=LidarConfig(key="l", encoding="cdr"),
    ego=EgoConfig(key="e"),
    T_camera_lidar=IDENTITY,
)
CLOUD = LidarFrame(5, "lidar", np.ones((2, 3), np.float32))
MOTION = EgoMotion(5, "base", (1.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def camera(sequence: int | None = None, frame_id: str = "camera", width: int = 4, height: int = 3) -> CameraFrame:
    image = EncodedImage(ImageFormat.MONO8, width, height, bytes(width * height))
    return CameraFrame(5, frame_id, image, sequence)


class Bench:
    """Decoders and what they lost."""

    def __init__(self, pair: PairConfig = PAIR) -> None:
        self.losses = LossCounter(logging.getLogger("test"), "front")
        self.decoders = {
            name: Decoder(name, stream, LimitsConfig(), self.losses) for name, stream in pair.streams.items()
        }

    def take(self, stream: str, payload: bytes, encoding: str = "zenoh/bytes") -> object:
        return self.decoders[stream].frame(InputSample(payload, encoding))


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_samples_encoding_is_believed(bench: Bench) -> None:
    type_name, image = message_encoding.encode_image(camera())
    assert bench.take(CAMERA, msgpack_frames.encode_camera(camera()), MSGPACK) == camera()
    assert bench.take(CAMERA, image, f"{CDR};{type_name}") == camera()
    assert bench.take(CAMERA, image, CDR) == camera(), "the type of the configuration"
    assert isinstance(bench.take(LIDAR, msgpack_frames.encode_lidar(CLOUD), MSGPACK), LidarFrame)
    assert isinstance(bench.take(EGO, message_encoding.encode_motion(MOTION)[1], CDR), EgoMotion)
    assert not bench.losses.snapshot()


def test_clouds_in_another_frame_come_back_to_the_lidars() -> None:
    T = ((0.0, -1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 2.0), (0.0, 0.0, 1.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    lidar = LidarConfig(key="l", cloud_frame_id="base_link", T_cloud_lidar=T)
    bench = Bench(PAIR.model_copy(update={"lidar": lidar}))
    in_base = LidarFrame(5, "base_link", np.array([[1.0, 3.0, 4.0]], np.float32))
    frame = bench.take(LIDAR, msgpack_frames.encode_lidar(in_base), MSGPACK)
    assert isinstance(frame, LidarFrame)
    assert frame.frame_id == "lidar"
    np.testing.assert_array_equal(frame.xyz_m, [[1.0, 0.0, 1.0]])
    assert bench.take(LIDAR, msgpack_frames.encode_lidar(CLOUD), MSGPACK) is None, "no frame of the configuration"


@pytest.mark.fault(
    "a cloud in the vehicle's frame, its origin not stated",
    "refused as `cloud_origin`, and the log says from where it looks measured",
)
def test_a_cloud_that_contradicts_its_origin_is_refused(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    cloud = replace(sweep_in_frame(turning_sweep(), ROOF_POSE), frame_id="lidar")
    assert bench.take(LIDAR, msgpack_frames.encode_lidar(cloud), MSGPACK) is None
    assert bench.losses.snapshot() == {(LIDAR, "cloud_origin"): 1}
    assert "look as if measured from" in caplog.text


def test_where_points_come_from_is_checked_once_a_second_and_always_while_it_is_wrong(bench: Bench) -> None:
    true, moved = (
        replace(turning_sweep(), frame_id="lidar"),
        replace(sweep_in_frame(turning_sweep(), ROOF_POSE), frame_id="lidar"),
    )

    def taken(sweep: LidarFrame, stamp_s: float) -> bool:
        stamped = replace(sweep, stamp_ns=round(stamp_s * 1e9))
        return bench.take(LIDAR, msgpack_frames.encode_lidar(stamped), MSGPACK) is not None

    observations = [
        (true, 10.2),
        (moved, 10.3),
        (moved, 11.1),
        (moved, 11.2),
        (true, 11.3),
        (moved, 11.4),
        (moved, 12.0),
    ]
    assert [taken(*observation) for observation in observations] == [True, True, False, False, True, True, False]


@pytest.mark.fault(
    "two LiDARs in one cloud, and no field tells them apart",
    "refused as `cloud_concatenated`, and the log says from where they look measured",
)
def test_a_cloud_of_two_lidars_is_refused(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    here, there = turning_sweep(1), sweep_in_frame(turning_sweep(2), ROOF_POSE)
    assert here.ring is not None
    assert there.ring is not None
    xyz_m, ring = np.concatenate([here.xyz_m, there.xyz_m]), np.concatenate([here.ring, there.ring])
    cloud = LidarFrame(5, "lidar", xyz_m, ring=ring)
    assert bench.take(LIDAR, msgpack_frames.encode_lidar(cloud), MSGPACK) is None
    assert bench.losses.snapshot() == {(LIDAR, "cloud_concatenated"): 1}
    assert "See lidar.source." in caplog.text


def test_else_the_configurations(bench: Bench) -> None:
    assert bench.take(CAMERA, msgpack_frames.encode_camera(camera())) == camera()
    assert isinstance(bench.take(LIDAR, message_encoding.encode_cloud(CLOUD)), LidarFrame)
    assert bench.take(EGO, msgpack_frames.encode_ego(MOTION), "text/plain") == MOTION
    assert bench.decoders[EGO].counts().accepted == 1


@pytest.mark.parametrize(
    ("stream", "payload", "encoding", "reason"),
    [
        (CAMERA, msgpack_frames.encode_camera(camera(frame_id="other")), MSGPACK, "frame_id"),
        (CAMERA, msgpack_frames.encode_camera(camera(width=5)), MSGPACK, "image_size"),
        (CAMERA, message_encoding.encode_cloud(CLOUD), f"{CDR};sensor_msgs/msg/PointCloud2", "wrong_type"),
        (LIDAR, bytes(33 * 2**20), CDR, "message_too_large"),
    ],
)
def test_what_does_not_fit_is_counted_by_reason(
    bench: Bench, stream: str, payload: bytes, encoding: str, reason: str
) -> None:
    assert bench.take(stream, payload, encoding) is None
    assert bench.losses.snapshot() == {(stream, reason): 1}
    assert (bench.decoders[stream].counts().received, bench.decoders[stream].counts().accepted) == (1, 0)


TF_EGO = EgoConfig(topic="/tf", type="tf2_msgs/msg/TFMessage", parent="map", child="ego")


def test_the_motion_in_transforms_takes_two_and_what_reports_none_is_no_loss() -> None:
    bench = Bench(PAIR.model_copy(update={"ego": TF_EGO}))
    begin, end = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
    messages = [
        transforms(("map", "ego", 10**9, begin)),
        transforms(("ego", "wheel", 10**9, begin)),
        transforms(("map", "ego", 10**9 + 20_000_000, end)),
    ]
    frames = [bench.take(EGO, message, f"{CDR};tf2_msgs/msg/TFMessage") for message in messages]
    assert frames[:2] == [None, None]
    assert isinstance(frames[2], EgoMotion)
    assert frames[2].linear_mps == pytest.approx((5.0, 0.0, 0.0))
    assert (bench.decoders[EGO].counts().received, bench.decoders[EGO].counts().accepted) == (3, 1)
    assert not bench.losses.snapshot()


def test_times_that_may_mean_two_things_are_counted_and_the_log_says_what_to_do(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    columns = [*((axis, "<f4", [1.0, 2.0]) for axis in "xyz"), ("time", "<f4", [0.0, 5.0])]
    assert bench.take(LIDAR, packed_cloud(columns), CDR) is None
    assert bench.losses.snapshot() == {(LIDAR, "cloud_time_ambiguous"): 1}
    assert "lidar.time: {field: time, unit: s, base: stamp}" in caplog.text

    reported = Bench(
        PAIR.model_copy(update={"lidar": LidarConfig(key="l", time=PointTimeConfig(field="time", unit="ms"))})
    )
    frame = reported.take(LIDAR, packed_cloud(columns), CDR)
    assert isinstance(frame, LidarFrame)
    assert frame.time_offset_s is not None
    assert frame.time_offset_s.tolist() == pytest.approx([0.0, 0.005])
    assert reported.decoders[LIDAR].timed_by == "time: float32, ms since the stamp; 0.0 to 5.0 ms, stamped at its begin"
    assert reported.take(LIDAR, packed_cloud(columns[:3]), CDR) is None, "a field that was named has to be there"
    assert reported.losses.snapshot() == {(LIDAR, "cloud_fields"): 1}


def test_ring_numbers_that_are_no_scan_lines_are_left_out_and_the_log_says_so_once(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    sweep = turning_sweep()
    columns = [(axis, "<f4", sweep.xyz_m[:2000, index].tolist()) for index, axis in enumerate("xyz")]
    for _ in range(2):
        frame = bench.take(LIDAR, packed_cloud([*columns, ("line", "u1", [k % 6 for k in range(2000)])]), CDR)
        assert isinstance(frame, LidarFrame)
        assert frame.ring is None
    assert caplog.text.count("are no scan lines") == 1
    assert sweep.ring is not None
    frame = Bench().take(LIDAR, packed_cloud([*columns, ("ring", "<u2", sweep.ring[:2000].tolist())]), CDR)
    assert isinstance(frame, LidarFrame)
    assert frame.ring is not None


def test_clouds_that_are_parts_of_a_turn_are_named(bench: Bench) -> None:
    def frames_of(bench: Bench, parts: int) -> tuple[str, ...]:
        for number in range(MOST_CLOUDS):
            sweep = turning_sweep(number // parts)
            share = np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0]) / (2 * np.pi) + 0.5
            part = sweep.xyz_m[np.floor(share * parts).clip(0, parts - 1) == number % parts]
            cloud = LidarFrame(5 + number, "lidar", np.ascontiguousarray(part))
            assert bench.take(LIDAR, msgpack_frames.encode_lidar(cloud), MSGPACK) is not None
        return bench.decoders[LIDAR].counts().notes

    (note,) = frames_of(bench, 8)
    assert "each cloud covers a part of the turn, 8 in a row the whole" in note
    assert frames_of(Bench(), 1) == ()


def test_an_odometry_without_velocities_gives_the_motion_of_its_poses(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    motion: object = None
    for number in range(700):
        packer = Packer().header("odom", 1 + number // 200, number % 200 * 5_000_000).text("base")
        packer.put("d", 0.04 * number, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *[0.0] * (36 + 6 + 36))
        motion = bench.take(EGO, packer.done(), CDR)
    assert isinstance(motion, EgoMotion)
    assert motion.linear_mps == pytest.approx((8.0, 0.0, 0.0))
    assert caplog.text.count("are not filled in, by its poses") == 1
    (note,) = bench.decoders[EGO].counts().notes
    assert "ego.motion: twist" in note


def test_a_type_that_people_take_for_the_right_one_is_distinguished(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    assert bench.take(LIDAR, b"", f"{CDR};velodyne_msgs/msg/VelodyneScan") is None
    assert bench.losses.snapshot() == {(LIDAR, "wrong_type"): 1}
    assert "PointCloud2" in caplog.text


@pytest.mark.fault("rubbish on a sensor's key", "it is counted once, by its reason")
@pytest.mark.parametrize("payload", [b"", b"\xc1", b"\x80", b"\xdd\xff\xff\xff\xff", b"\x00\x01\x00\x00"])
@pytest.mark.parametrize("encoding", [MSGPACK, CDR, f"{CDR};no_such/msg/Type", "", ";;;"])
@pytest.mark.parametrize("stream", [CAMERA, LIDAR, EGO])
def test_rubbish_is_counted_once(bench: Bench, stream: str, payload: bytes, encoding: str) -> None:
    assert bench.take(stream, payload, encoding) is None
    ((place, reason),) = bench.losses.snapshot()
    assert place == stream
    assert reason != "decoder_fault"


@pytest.mark.fault("a fault of our own in a decoder", "it costs the message only")
def test_a_fault_of_a_decoder_costs_the_message_only(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(msgpack_frames, "decode_ego", lambda *_: 1 // 0)
    assert bench.take(EGO, b"", MSGPACK) is None
    assert bench.losses.snapshot() == {(EGO, "decoder_fault"): 1}


def test_gaps_in_the_numbers_are_loss_but_a_new_count_is_not(bench: Bench) -> None:
    for sequence in (7, 8, 11, 11, 0, 1, 2_000_000, 2_000_001, 2_000_002):
        assert bench.take(CAMERA, msgpack_frames.encode_camera(camera(sequence)), MSGPACK) is not None
    assert bench.losses.snapshot() == {(CAMERA, "sequence_gap"): 2}


@pytest.mark.fault(
    "another sensor, with its own frame id or image size, sends on a native key",
    "its frames are refused, those of the stream are used, and health says so",
)
@pytest.mark.parametrize("odd", [camera(5000, frame_id="other"), camera(5000, width=6)], ids=["frame id", "size"])
def test_frames_of_another_sensor_are_not_mixed_in(bench: Bench, odd: CameraFrame) -> None:
    frames = []
    for number in range(20):
        frames.append(bench.take(CAMERA, msgpack_frames.encode_camera(camera(number)), MSGPACK))
        theirs = replace(odd, sequence=5000 + number)
        assert bench.take(CAMERA, msgpack_frames.encode_camera(theirs), MSGPACK) is None
    counts = bench.decoders[CAMERA].counts()
    assert (None in frames, counts.foreign, counts.taking_turns) == (False, True, ())
    assert {reason for _, reason in bench.losses.snapshot()} <= {"frame_id", "image_size"}
    (problem,) = stream_problems({CAMERA: counts}, PAIR, RosTopicList())
    assert problem.code == "foreign_frames"
    for number in range(20, 20 + RECENT):
        bench.take(CAMERA, msgpack_frames.encode_camera(camera(number)), MSGPACK)
    assert not bench.decoders[CAMERA].counts().foreign


@pytest.mark.fault("two sources of ego-motion, each in a frame of its own", "one of them is used until it ends")
def test_ego_motion_keeps_to_the_frame_that_it_began_with(bench: Bench) -> None:
    def taken(frame_id: str, number: int) -> bool:
        motion = replace(MOTION, frame_id=frame_id, sequence=number)
        return bench.take(EGO, msgpack_frames.encode_ego(motion), MSGPACK) is not None

    assert [(taken("base", n), taken("other", 900 + n)) for n in range(100)] == [(True, False)] * 100
    assert [taken("other", 1000 + n) for n in range(RECENT)] == [*[False] * (RECENT - 2), True, True]


@pytest.mark.fault(
    "a second vehicle sends on the same native keys, with the same frame ids and numbers of its own",
    "no frame of either is used until one ends, and health says so",
)
def test_frames_of_two_vehicles_are_not_mixed() -> None:
    stream = SensorStream(CAMERA, "camera-0", PAIR.camera, LimitsConfig())
    used: list[Frame] = []

    def put(number: int, stamp_ns: int) -> None:
        frame = replace(camera(number), stamp_ns=stamp_ns)
        used.extend(stream.take(InputSample(msgpack_frames.encode_camera(frame), MSGPACK), 0.0))

    for index in range(30):
        put(index, index * 10**8)
    assert len(used) == 30
    put(7000, 29 * 10**8 + 10**7)
    assert len(used) == 30, "the first frame of another is kept back"
    for index in range(30, 60):
        put(index, index * 10**8)
        put(6971 + index, index * 10**8 + 10**7)
    counts = stream.decoder.counts()
    assert (len(counts.taking_turns), len(used)) == (2, 30)
    (problem,) = stream_problems({CAMERA: counts}, PAIR, RosTopicList())
    assert (problem.code, "refused until only one sends" in problem.text) == ("two_senders", True)
    assert stream.losses.snapshot() == {(CAMERA, "two_senders"): 61}
    for index in range(60, 60 + RECENT + 10):
        put(index, index * 10**8)
    assert len(used) > 30
    assert all(frame.sequence is not None and frame.sequence < 7000 for frame in used)
    assert stream.decoder.counts().taking_turns == ()


def test_a_sensor_that_is_started_again_loses_no_frame() -> None:
    stream = SensorStream(CAMERA, "camera-0", PAIR.camera, LimitsConfig())
    used: list[Frame] = []
    for number in (*range(1000, 1030), *range(30)):
        payload = msgpack_frames.encode_camera(replace(camera(number), stamp_ns=5 + len(used)))
        used += stream.take(InputSample(payload, MSGPACK), 0.0)
    assert [frame.sequence for frame in used] == [*range(1000, 1030), *range(30)]
    assert stream.losses.snapshot() == {}


@pytest.mark.fault("a frame that is overtaken by another", "it is counted once")
def test_a_frame_that_was_overtaken_is_counted_once(bench: Bench) -> None:
    """As out of order by the pairer, and not as missing by the decoder as well."""
    pairer = Pairer(PairingConfig(), expects_motion=False)
    for sequence in (1, 3, 2, *range(4, 40)):
        frame = replace(camera(sequence), stamp_ns=sequence * 10**8)
        taken = bench.take(CAMERA, msgpack_frames.encode_camera(frame), MSGPACK)
        assert isinstance(taken, CameraFrame)
        pairer.push(taken)
    assert bench.losses.snapshot() == {}
    assert pairer.losses["camera_stamp_back"] == 1


@pytest.mark.fault("a flood of bad messages", "the log grows only with the logarithm of their number")
def test_losses_are_logged_first_and_then_ever_more_rarely(caplog: pytest.LogCaptureFixture) -> None:
    losses = LossCounter(logging.getLogger("test"), "front")
    for _ in range(1000):
        losses.add(CAMERA, "frame_id")
    assert len(caplog.records) == 10  # 1, 2, 4, ... 512
    assert losses.snapshot() == {(CAMERA, "frame_id"): 1000}


# --- the inbox ---------------------------------------------------------------------------------------------------


@pytest.mark.fault("more samples than can be read", "the newest are read, and the lost ones counted")
def test_samples_are_taken_in_the_order_of_arrival_and_the_oldest_go_first() -> None:
    overruns: list[str] = []
    inbox = Inbox({CAMERA: 2, EGO: 8}, 100, lambda parcel: overruns.append(parcel.stream))
    for number, stream in enumerate([CAMERA, EGO, CAMERA, EGO, CAMERA]):
        inbox.put(stream, InputSample(bytes([number]), ""))
    taken = [inbox.take(0.0) for _ in range(5)]
    assert [item.sample.payload[0] for item in taken if isinstance(item, Parcel)] == [1, 2, 3, 4]
    assert taken[-1] is None
    assert overruns == [CAMERA]


def test_too_many_bytes_take_from_the_stream_that_holds_most() -> None:
    overruns: list[str] = []
    inbox = Inbox({CAMERA: 16, LIDAR: 16, EGO: 16}, 100, lambda parcel: overruns.append(parcel.stream))
    for number in range(3):
        inbox.put(LIDAR, InputSample(bytes([number]) * 20, ""))
    inbox.put(EGO, InputSample(b"e", ""))
    for number in range(4):
        inbox.put(CAMERA, InputSample(bytes([number]) * 30, ""))
    # One camera frame fits beside the three sweeps; of the others each makes room for itself.
    assert overruns == [CAMERA] * 3
    taken = [inbox.take(0.0) for _ in range(6)]
    payloads = [item.sample.payload for item in taken if isinstance(item, Parcel)]
    assert payloads == [b"\0" * 20, b"\1" * 20, b"\2" * 20, b"e", b"\3" * 30]


def test_a_sample_larger_than_all_that_may_wait_is_taken_alone() -> None:
    overruns: list[str] = []
    inbox = Inbox({CAMERA: 16, LIDAR: 16}, 100, lambda parcel: overruns.append(parcel.stream))
    inbox.put(LIDAR, InputSample(b"sweep", ""))
    inbox.put(CAMERA, InputSample(bytes(200), ""))
    assert overruns == [LIDAR]
    inbox.put(CAMERA, InputSample(b"next", ""))
    assert overruns == [LIDAR, CAMERA]
    taken = inbox.take(0.0)
    assert isinstance(taken, Parcel)
    assert taken.sample.payload == b"next"


def test_an_event_comes_before_what_waits_and_a_waiting_reader_is_woken() -> None:
    inbox = Inbox({CAMERA: 2}, 100, lambda _: None)
    inbox.put(CAMERA, InputSample(b"", ""))
    inbox.post("front", "event")
    assert isinstance(inbox.take(0.0), Posted)
    assert isinstance(inbox.take(0.0), Parcel)
    got: list[object] = []
    reader = threading.Thread(target=lambda: got.append(inbox.take(60.0)))
    reader.start()
    inbox.put(CAMERA, InputSample(b"x", ""))
    reader.join(20.0)
    assert len(got) == 1
    assert isinstance(got[0], Parcel)


@pytest.mark.fault("a driver that fills `ring` with one number", "the field is ignored, and the log says so once")
def test_a_ring_that_distinguishes_no_beams_is_reported_once(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    sweep = turning_sweep()
    for number, ring in enumerate((sweep.ring, np.full(len(sweep.xyz_m), 7, np.uint16)) * 3):
        report = replace(sweep, stamp_ns=(1 + 3600 * number) * 10**9, ring=ring)
        assert bench.take(LIDAR, msgpack_frames.encode_lidar(report), MSGPACK) is not None
    reported = [message for message in caplog.messages if "`ring`" in message]
    assert len(reported) == 1
    assert "ignored" in reported[0]
