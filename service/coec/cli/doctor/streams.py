"""Findings on the streams of a pair, judged by what the service needs."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from statistics import median

import numpy as np

from coec.adapters.depth.maps import STEREO
from coec.adapters.images.codec import Inspector
from coec.adapters.zenoh.ros_topics import Topics
from coec.calibration.types import CameraFrame, LidarFrame
from coec.cli.doctor.found import fail, ok, warn
from coec.cli.doctor.listening import Heard
from coec.cli.doctor.router import cause_of_silence
from coec.config import Config, PairConfig
from coec.errors import DecodeError
from coec.runtime.api.streams import troubles_of
from coec.runtime.api.troubles import TROUBLES
from coec.runtime.ingest.decoder import CAMERA, EGO, LIDAR
from coec.schemas.doctor import Finding

NS_PER_S = 1_000_000_000

OFF_S = 1.0
"""Most time between the stamp of a frame and its arrival: a sweep takes 0.1 s, and its way here as much again."""

PACE = 0.1
"""Share by which sensor time may run faster or slower than this computer's clock, as in a replay."""

PARTNERS = 0.9
"""Least share of the camera frames that should have a sweep near in time."""

PERIOD = 0.1
"""Share by which the rate of sweeps may differ from `sweep.period_s`."""

LARGE = 0.8
"""Share of the largest accepted message from which on there is a warning."""


def stream_findings(
    pair: PairConfig, heard: Mapping[str, Heard], config: Config, seconds: float, topics: Topics
) -> Iterator[Finding]:
    """Findings on the streams of one pair."""
    for name, one in heard.items():
        yield from _stream(pair, name, one, config, seconds, topics)
    counts = {name: one.counts for name, one in heard.items() if one.counts is not None}
    for reason in troubles_of(counts, pair, topics):
        yield warn("senders", pair.name, reason.text, TROUBLES[reason.code].advice)
    camera, lidar, ego = heard[CAMERA], heard[LIDAR], heard.get(EGO)
    if camera.stamps and lidar.stamps:
        yield _in_step(pair, camera.stamps, lidar.stamps)
    if camera.stamps and ego is not None and ego.stamps:
        yield _with_motion(pair, camera.stamps, ego.stamps)
    if isinstance(lidar.latest, LidarFrame):
        yield _point_times(pair, lidar.latest, lidar.rate_hz)
    if isinstance(camera.latest, CameraFrame):
        yield from _image(pair, camera.latest, config)


def _stream(
    pair: PairConfig, name: str, heard: Heard, config: Config, seconds: float, topics: Topics
) -> Iterator[Finding]:
    if not heard.arrivals_s:
        stream = pair.streams[name]
        absent = None if stream.topic is None else topics.absent(stream.topic, stream.types)
        yield _silent(name, heard, config, seconds, absent)
        return
    yield _rate(pair, name, heard, seconds)
    largest, limit = max(heard.sizes), config.limits.max_message_bytes
    if largest > LARGE * limit:
        text = f"{name}: {largest / 1e6:.1f} MB in the largest sample, of {limit / 1e6:.1f} that are taken"
        yield warn("size", heard.place, text, "raise limits.max_message_bytes, here and at the router, or send less")
    if heard.refused:
        causes = ", ".join(f"{count} {reason}" for reason, count in heard.refused.most_common())
        advice = "see that encoding, type, frame id and image size are those of the configuration, and its limits"
        if heard.latest is None:
            yield fail("decoding", heard.place, f"{name}: no sample makes a frame: {causes}", advice)
        else:
            yield warn("decoding", heard.place, f"{name}: some samples make no frame: {causes}", advice)
    if heard.stamps:
        yield _clock(name, heard)


def awaited_findings(awaited: Mapping[str, Heard], config: Config, seconds: float, topics: Topics) -> Iterator[Finding]:
    """Findings on what pairs wait for whose configuration leaves something out."""
    for place, heard in awaited.items():
        if heard.arrivals_s:
            count = len(heard.arrivals_s)
            told = f"{heard.rate_hz:.1f} Hz" if heard.rate_hz else f"{count} message{'s' if count > 1 else ''}"
            yield ok("stream", place, f"{told}, {median(heard.sizes) / 1e3:.1f} kB each")
        else:
            absent = None if topics.of(place) else f"no publisher of {place}"
            yield _silent("awaited", heard, config, seconds, absent)


def _silent(name: str, heard: Heard, config: Config, seconds: float, absent: str | None) -> Finding:
    """The finding on a stream of which nothing came; `absent` says that nobody publishes its topic."""
    text = f"{name}: nothing came in {seconds:g} s"
    if heard.elsewhere:
        cause, advice = cause_of_silence(config)
        got = f"a client of the same router got {heard.elsewhere} samples"
        return fail("stream", heard.place, f"{text}, while {got}: {cause}", advice)
    if absent is not None:
        return fail("stream", heard.place, f"{text}: {absent}", "start its node, or name the topic that is meant")
    advice = (
        "see that its publisher runs, on this router, with this key or topic; and that the router's rules let this "
        "certificate subscribe to it"
    )
    return fail("stream", heard.place, text, advice)


def _rate(pair: PairConfig, name: str, heard: Heard, seconds: float) -> Finding:
    # From a single sample only this much is known: the next one did not come while the doctor listened.
    rate_hz = heard.rate_hz or 2.0 / seconds
    told = f"{rate_hz:.1f} Hz" if heard.rate_hz else f"one sample in {seconds:g} s"
    load = sum(heard.sizes) / seconds / 1e6
    text = f"{name}: {told}, {median(heard.sizes) / 1e3:.1f} kB each, {load:.1f} MB/s"
    monitor = pair.monitor
    if name == EGO:
        wanted_hz = least_hz = 0.5 / pair.pairing.motion_tolerance_s
        why = f"pairs need one within {pair.pairing.motion_tolerance_s:g} s"
    else:
        wanted_hz, least_hz = monitor.pairs / monitor.period_s, monitor.min_pairs / monitor.period_s
        why = f"a check wants {monitor.pairs} pairs in {monitor.period_s:g} s, and needs {monitor.min_pairs}"
    advice = "a faster stream, or a longer monitor.period_s"
    if rate_hz < least_hz:
        return fail("stream", heard.place, f"{text}: {why}", advice)
    if heard.rate_hz is None:
        return warn("stream", heard.place, f"{text}: {why}", "listen for longer (--seconds)")
    if rate_hz < wanted_hz:
        return warn("stream", heard.place, f"{text}: {why}", advice)
    return ok("stream", heard.place, text)


def _clock(name: str, heard: Heard) -> Finding:
    """Compares the stamps with the clock of this computer."""
    late_s = median((wall_ns - stamp_ns) / NS_PER_S for stamp_ns, wall_ns in heard.stamps)
    back = sum(b[0] < a[0] for a, b in zip(heard.stamps, heard.stamps[1:], strict=False))
    sensor_s = (heard.stamps[-1][0] - heard.stamps[0][0]) / NS_PER_S
    here_s = (heard.stamps[-1][1] - heard.stamps[0][1]) / NS_PER_S
    if back:
        advice = "see to the clock of the sensor: it is set back, or two of them send under one key"
        return warn("stamps", heard.place, f"{name}: {back} stamps step back", advice)
    if abs(late_s) > OFF_S:
        side = "behind" if late_s > 0 else "ahead of"
        text = f"{name}: its stamps are {abs(late_s):.1f} s {side} the clock of this computer"
        advice = "synchronise the sensor's clock (PTP); the calibration goes on, dates of the history are those stamps"
        return warn("stamps", heard.place, text, advice)
    if here_s > 1.0 and abs(sensor_s / here_s - 1.0) > PACE:
        text = f"{name}: its time runs {sensor_s / here_s:.2f} times as fast as this computer's"
        return warn("stamps", heard.place, text, "nothing, if this is a replay; else see to the sensor's clock")
    return ok("stamps", heard.place, f"{name}: {1e3 * late_s:.0f} ms from stamp to arrival")


def _nearest_ns(stamps_ns: Sequence[int], others_ns: Sequence[int]) -> list[int]:
    """Signed distance from each stamp to the nearest of the others."""
    others = sorted(others_ns)
    found = []
    for stamp in stamps_ns:
        index = bisect_left(others, stamp)
        found.append(min((one - stamp for one in others[max(index - 1, 0) : index + 1]), key=abs))
    return found


def _in_step(pair: PairConfig, camera: Sequence[tuple[int, int]], lidar: Sequence[tuple[int, int]]) -> Finding:
    """Whether camera and LiDAR are in step, by their stamps."""
    where = pair.name
    away_ns = _nearest_ns([stamp for stamp, _ in camera], [stamp for stamp, _ in lidar])
    tolerance_s = pair.pairing.tolerance_s
    # At both ends of the recorded time a partner may be missing.
    inside = away_ns[1:-1] or away_ns
    share = sum(abs(away) <= tolerance_s * NS_PER_S for away in inside) / len(inside)
    typical_s = median(away_ns) / NS_PER_S
    text = f"camera and LiDAR: {100 * share:.0f} % of the frames have a sweep within {tolerance_s:g} s"
    if share == 0.0:
        text += f"; they are {abs(typical_s):.3f} s apart"
        return fail("in_step", where, text, "put both sensors on one clock (PTP), or correct the driver's stamps")
    if share < PARTNERS:
        advice = "trigger the camera by the LiDAR, or raise pairing.tolerance_s; frames without a partner are dropped"
        return warn("in_step", where, text, advice)
    return ok("in_step", where, f"{text}, typically {1e3 * typical_s:+.1f} ms")


def _with_motion(pair: PairConfig, camera: Sequence[tuple[int, int]], ego: Sequence[tuple[int, int]]) -> Finding:
    away_ns = _nearest_ns([stamp for stamp, _ in camera], [stamp for stamp, _ in ego])
    inside = away_ns[1:-1] or away_ns
    tolerance_s = pair.pairing.motion_tolerance_s
    share = sum(abs(away) <= tolerance_s * NS_PER_S for away in inside) / len(inside)
    text = f"ego-motion: {100 * share:.0f} % of the frames have one within {tolerance_s:g} s"
    if share < PARTNERS:
        advice = "put both on one clock; without ego-motion sweeps are not compensated, and standing is not seen"
        return warn("in_step", pair.name, text, advice)
    return ok("in_step", pair.name, text)


def _point_times(pair: PairConfig, cloud: LidarFrame, rate_hz: float | None) -> Finding:
    """The finding on the times of points within a sweep."""
    key, times_s = pair.lidar.place, cloud.time_offset_s
    count = len(cloud.xyz_m)
    if count == 0:
        return fail("point_times", key, "the last sweep has no point", "see to the LiDAR")
    if times_s is None:
        return _by_azimuth(pair, rate_hz)
    first_s, last_s = float(np.min(times_s)), float(np.max(times_s))
    read = cloud.timed_by or f"measured {1e3 * first_s:+.1f} to {1e3 * last_s:+.1f} ms from the stamp"
    text = f"{count} points, {read}"
    period_s = 1.0 / rate_hz if rate_hz else 0.1
    if max(abs(first_s), abs(last_s)) > 2.0 * period_s:
        advice = "the field holds another unit, or time since another moment: correct it in the driver"
        return fail("point_times", key, f"{text}: further than two sweeps", advice)
    if last_s == first_s:
        advice = "have the driver fill in the field, or leave it out and set lidar.sweep"
        return warn("point_times", key, f"{text}: all the same, nothing is compensated by them", advice)
    return ok("point_times", key, text)


def _by_azimuth(pair: PairConfig, rate_hz: float | None) -> Finding:
    key, sweep = pair.lidar.place, pair.lidar.sweep
    if sweep is None:
        if not pair.calibration.motion_compensation:
            return ok("point_times", key, "none, and none are needed: sweeps are not compensated")
        advice = "have the driver send a time of each point, or set lidar.sweep for a spinning LiDAR"
        return warn("point_times", key, "points have no time: sweeps cannot be compensated", advice)
    if rate_hz is not None and abs(rate_hz * sweep.period_s - 1.0) > PERIOD:
        text = f"lidar.sweep.period_s is {sweep.period_s:g} s, but sweeps come every {1.0 / rate_hz:.3f} s"
        return warn("point_times", key, text, "correct lidar.sweep, or see why sweeps are lost")
    return ok("point_times", key, "of the azimuth, by lidar.sweep")


def _image(pair: PairConfig, frame: CameraFrame, config: Config) -> Iterator[Finding]:
    """Findings on the picture itself, which the service inspects when it cuts a window."""
    key, window = pair.camera.place, pair.window
    try:
        quality = Inspector(config.limits).inspect(frame)
    except DecodeError as error:
        yield fail("image", key, f"the picture cannot be decoded: {error}", "see to the camera's encoder")
        return
    told = f"level {quality.mean_level:.0f} of 255, {100 * quality.clipped:.0f} % clipped"
    told += f", sharpness {quality.sharpness:.3f}"
    objections = [
        word
        for word, wrong in (
            ("too dark", quality.mean_level < window.min_mean_level),
            ("clipped", quality.clipped > window.max_clipped),
            ("blurred", quality.sharpness < window.min_sharpness),
        )
        if wrong
    ]
    if objections:
        advice = "clean the lens, see to exposure and focus; windows are not cut from such pictures (pair window.*)"
        yield warn("image", key, f"{told}: {', '.join(objections)}", advice)
    else:
        yield ok("image", key, told)
    if pair.calibration.depth.model == STEREO and frame.depth is None:
        advice = "send depth maps with the frames, or name a network in calibration.depth.model"
        yield fail("depth", key, "frames carry no depth map, and the configuration counts on them", advice)
