"""Problems of the service itself, which `health` and `status` give beside the state of the calibration: what each
means and what to do about it, and the detection of those that concern the senders of a pair's streams, the rig, and
the router. `docs/operations.md` and the advice of `coec doctor` are made from the one table `PROBLEMS`.

`docs/operations.md` and the advice of `coec doctor` are made from this one table.
"""

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import degrees, isfinite

from coec.calibration.rig.attribution import SensorHealth
from coec.calibration.rig.joint_estimate import JointEstimate
from coec.calibration.rig.rig_estimator import RigAlarm, VehicleRig, rig_alarms
from coec.calibration.types import Reason
from coec.config import PairConfig
from coec.io.zenoh.ros_node import RosTopicList, listed
from coec.service.ingest.decoder import StreamCounts
from coec.service.ingest.inbox import Arrivals


@dataclass(frozen=True, slots=True)
class Problem:
    """What a problem means, and what to do about it."""

    meaning: str
    advice: str


PROBLEMS: Mapping[str, Problem] = {
    "no_router": Problem(
        "No connection to a Zenoh router: no frames are received and no queries are answered.",
        "Start the router, or check the network; `coec doctor` tests the connection step by step. The service "
        "reconnects by itself.",
    ),
    "two_senders": Problem(
        "Two publishers send on one topic or key at the same time. The service cannot determine which is the sensor, "
        "so all frames are refused until only one has sent for 64 messages. Meanwhile nothing is checked or "
        "calibrated.",
        "Stop one of the two, or configure the topic of the right one; `coec doctor` lists topics and nodes. If the "
        "other belongs to another vehicle, configure separate keys for each vehicle.",
    ),
    "foreign_frames": Problem(
        "Frames with another frame id or image size arrive on the key of the sensor; they are refused and counted.",
        "Find and stop the program that publishes them on this topic or key (another sensor, another vehicle).",
    ),
    "sender_clock": Problem(
        "Messages of a stream have no stamp; the time of sending replaces the sensor's stamp.",
        "Configure the driver to stamp its messages by the clock of the sensors.",
    ),
    "inconsistent_rig": Problem(
        "The pairs of the vehicle are inconsistent about the poses of its sensors; `coec query rig` shows the "
        "residuals.",
        "Nothing while windows are recorded: a pair whose window is from before a move becomes consistent with its "
        "next one. If the reason stays, check the settings of the pair (intrinsics, clocks, masks), and `links`.",
    ),
    "sensor_suspected": Problem(
        "The pairs of the vehicle are inconsistent about the poses of its sensors, and a sensor of this pair may have "
        "moved; `coec query rig` gives the displacement and its probability.",
        "Nothing: the next checks identify the sensor, lead to `inconsistent_rig`, or show that all pairs are "
        "consistent.",
    ),
    "sensor_moved": Problem(
        "A sensor of the pair moved (see `coec query rig`), and the pair still serves the calibration from before.",
        "Nothing while windows are recorded: one correction updates all its pairs. If the reason stays, `health` lists "
        "what the windows of the pair lack, or the pair is held or waits for `apply`.",
    ),
    "one_pair": Problem(
        "About `rig`: the vehicle has one pair, which cannot distinguish its camera from its LiDAR.",
        "Nothing: `health` of the pair reports whether either moved. A second camera with that LiDAR would distinguish "
        "them.",
    ),
    "no_rig": Problem(
        "About `rig`: there is no joint estimate, because the vehicle has more sensors than it supports.",
        "Nothing: every pair is calibrated by itself. Remove unneeded pairs to get a joint estimate of the others.",
    ),
    "lidars_not_installed": Problem(
        "There are several LiDARs, and the package that measures their relative poses is not installed.",
        "Install the extra `lidars`, or set `lidar_edges.period_s: 0`; everything else works without it.",
    ),
    "rig_state_damaged": Problem(
        "About `rig`: a part of the stored state cannot be read. It is quarantined and estimated again.",
        "Nothing after an update of the software, else check the disk of `state.directory`. A sensor that moved during "
        "the restart is reported by its pairs alone.",
    ),
    "insecure": Problem(
        "The service accepts connections without a certificate.",
        "Listen on loopback or on TLS with client certificates, and remove `zenoh.insecure`.",
    ),
    "http_unavailable": Problem(
        "Metrics are not served over HTTP: the address is not available.",
        "Free the port or configure another in `metrics.http`, and reload.",
    ),
    "http_insecure": Problem(
        "Other computers can read the metrics over HTTP.",
        "Listen on loopback, and remove `metrics.insecure`.",
    ),
    "worker_failed": Problem(
        "The worker process (inference and search) has ended and is being replaced.",
        "Nothing if it happens once; if it repeats, check its memory (`worker.max_memory_bytes`) and the log.",
    ),
    "compiling_kernels": Problem(
        "The worker compiles its kernels, once on a machine, and after an update that changes them; the text gives the "
        "progress. Meanwhile the extrinsic is served and windows are recorded; checks and solves start afterwards.",
        "Nothing: it takes a minute, and longer on a busy machine. `coec warmup` compiles the kernels beforehand.",
    ),
    "recording_failed": Problem(
        "The last window could not be written; the service will try the next one.",
        "Check the disk of `state.directory`: free space, owner, errors.",
    ),
    "recording_stuck": Problem(
        "The disk does not answer: no window can be written.",
        "Check the disk of `state.directory`; `coec doctor` measures it.",
    ),
    "disk_slow": Problem(
        "The disk takes longer than a command may wait: acknowledgements report the command as not yet durable.",
        "Check for other programs that write to the disk of `state.directory`; `coec doctor` measures it.",
    ),
    "disk_failing": Problem(
        "Writing state to the disk fails; the state is kept in memory and the write is repeated.",
        "Check the disk of `state.directory`: errors, owner, mount.",
    ),
    "disk_read_only": Problem(
        "The state directory is mounted read-only: no state survives a restart.",
        "Mount it for writing; no restart is needed.",
    ),
    "disk_full": Problem(
        "The disk of the state directory is full: the state waits in memory.",
        "Free space on the disk; no restart is needed.",
    ),
    "state_damaged": Problem(
        "The stored state, or a part of it, cannot be used and is quarantined; the text names what is lost and what is "
        "served.",
        "Restore the file from a backup, or calibrate if the nominal calibration is served; check the disk.",
    ),
    "state_other_version": Problem(
        "Another version of the software wrote parts of the state in a format that this one cannot read. Only these "
        "parts are reset; the text names them, and the file is quarantined.",
        "Nothing, unless the text reports that the nominal calibration is served: then calibrate, or return to the "
        "version that wrote the file.",
    ),
    "history_damaged": Problem(
        "The hash chain of the history is broken; the old history is quarantined.",
        "Find out who can write to the state directory, and check the disk.",
    ),
    "baseline_damaged": Problem(
        "The baseline of the rig cannot be read; the limits of the configuration apply.",
        "Commission the rig again, or restore the file.",
    ),
    "baseline_mismatch": Problem(
        "The baseline of the rig was learned with another rig, network or configuration, and is not used.",
        "Commission the rig again, or return to the rig, network and configuration of the baseline.",
    ),
    "monitor_blind": Problem(
        "Several checks in a row failed.",
        "Read the reason, which names the failure; check frames and network.",
    ),
    "windows_in_vain": Problem(
        "Several windows in a row failed.",
        "Read the reason, which names the failure; check frames and network.",
    ),
    "overdue_worker": Problem(
        "No check has been completed for three periods: the worker has not replied.",
        "Nothing while it starts or compiles kernels; else check its load and the log.",
    ),
    "overdue_depth": Problem(
        "No check has been completed for three periods: depth is missing.",
        "Check the depth network, or the depth maps of the frames.",
    ),
    "overdue_pairing": Problem(
        "No check has been completed for three periods: frames arrive, but images and sweeps do not match in time.",
        "Check the clocks of camera and LiDAR: `coec doctor` measures their difference.",
    ),
    "overdue_data": Problem(
        "No check has been completed for three periods: frames are missing, refused, or too few.",
        "Check the sensors, their keys and the access rules of the router: `coec doctor` listens for frames.",
    ),
    "overdue_budget": Problem(
        "No check has been completed for three periods: the processor budget is too small.",
        "Raise `budget.cores` to the value of `budget.wanted` in `status`, or lengthen `monitor.period_s` and "
        "`window.slice_s`.",
    ),
    "service_stuck": Problem(
        "The state of the pair is not updated: a disk or a thread is blocked.",
        "The service manager restarts the service if this lasts; check the disk.",
    ),
    "thread_died": Problem(
        "A thread of the service has died; the service ends with exit code 70.",
        "The service manager restarts it; report the traceback in the log.",
    ),
    "tokens_hidden": Problem(
        "The router hides the liveliness tokens of this vehicle: a second daemon would not be detected.",
        "Allow the service `liveliness_token` and `liveliness_query` in its rules, as `deploy/router.json5` does.",
    ),
    "two_daemons": Problem(
        "Another daemon serves the vehicle; this one ends with exit code 75.",
        "Stop one of the two, or give them different vehicle names.",
    ),
    "rival_unproven": Problem(
        "A program holds the liveliness token of another daemon of this vehicle, but no daemon answers for it. The "
        "token is ignored, and the calibration is served as before.",
        "Find and stop the program. Restrict tokens below `coec/@v1/<vehicle>` to the service in the router's rules, "
        "as `deploy/router.json5` does.",
    ),
    "no_look_yet": Problem(
        "Discovery has not yet searched for the settings that the configuration omits.",
        "Nothing; it searches four times a second.",
    ),
    "no_image": Problem(
        "A pair waits for its first image, which gives the camera's frame and the size of its images.",
        "Check the camera and its topic (`camera.topic`), or set `camera.frame_id` and `camera.intrinsics`.",
    ),
    "no_cloud": Problem(
        "A pair waits for its first cloud, which gives the frame of the points.",
        "Check the LiDAR and its topic, or set `lidar.frame_id` and `lidar.cloud_frame_id`.",
    ),
    "no_motion": Problem(
        "A pair waits for its first ego-motion, which gives the frame of the velocities.",
        "Check its topic, set `ego.T_lidar_ego`, or remove `ego`.",
    ),
    "no_frame_id": Problem(
        "The headers of a stream contain no frame id.",
        "Set the frame that the text names, or configure the driver to send it.",
    ),
    "several_sensors": Problem(
        "The images or clouds on one topic name several frames, so that several sensors publish on it.",
        "Give each sensor a topic of its own, or set the frame that the text names: frames of others are refused.",
    ),
    "no_camera_info": Problem(
        "A pair waits for the `CameraInfo` that gives the intrinsics.",
        "Configure the driver to publish it, set its topic in `camera.info_topic`, or set `camera.intrinsics`.",
    ),
    "camera_info_refused": Problem(
        "The `CameraInfo` cannot be used: it is not in CDR, uncalibrated, or of an unsupported camera model.",
        "Calibrate the camera, or set `camera.intrinsics`.",
    ),
    "camera_info_size": Problem(
        "The `CameraInfo` is for images of another size.",
        "Configure the driver to send its binning and region of interest, or set `camera.intrinsics`.",
    ),
    "tf_static": Problem(
        "`/tf_static` does not connect two frames of a pair.",
        "Publish the missing joint (robot_state_publisher does so from a URDF), or set what the text names.",
    ),
    "tf_static_no_tree": Problem(
        "`/tf_static` is not a tree between two frames: a frame with two parents, or a loop.",
        "Use one publisher per frame; the text names the frames.",
    ),
    "being_built": Problem(
        "Discovery is complete, and the pair is being created.",
        "Nothing; it takes a second.",
    ),
    "cannot_be_built": Problem(
        "The discovered calibration is invalid, for example a mask of another size.",
        "Correct what the text names; the service retries when something on the bus changes.",
    ),
    "nominal_changed": Problem(
        "`/tf_static` or `CameraInfo` differ from those with which the pair was created; its nominal calibration "
        "stays.",
        "If the new one is right: stop the service, remove `nominal.json` from `state.directory`, start it.",
    ),
    "held": Problem(
        "An operator holds the extrinsic; the text gives who, since when and why. The service itself works.",
        "`coec query command/hold --release` releases it.",
    ),
}
"""Problems by the code of the reason."""


SILENT_S = 5.0
"""After this time without a sample, s, a stream whose topic nobody publishes is reported as missing."""


def stream_problems(streams: Mapping[str, StreamCounts], pair: PairConfig, topics: RosTopicList) -> tuple[Reason, ...]:
    """Troubles of the streams, for `health`."""
    reasons = []
    for name, stream in pair.streams.items():
        counts = streams.get(name)
        if counts is None:
            continue
        if counts.taking_turns:
            known = topics.nodes_of(counts.taking_turns)
            who = f": {listed(known)}" if known else ""
            # Senders without names are told apart by what they send, which does not count them.
            several = f"{len(counts.taking_turns)} publishers" if known else "Several programs"
            text = f"{several} send on {stream.place} at the same time{who}."
            reasons.append(Reason("two_senders", f"{text} Their frames are refused until only one sends."))
        if counts.foreign:
            text = f"Frames with another frame id or image size arrive on {stream.place} beside those of the sensor"
            reasons.append(Reason("foreign_frames", f"{text}; they are refused."))
        if counts.stamped_by_sender:
            text = f"Messages on {stream.place} have no stamp: the clock of the sender stamps them."
            reasons.append(Reason("sender_clock", text))
    return tuple(reasons)


def missed_of(arrivals: Mapping[str, Arrivals], pair: PairConfig, topics: RosTopicList) -> tuple[str, ...]:
    """Sentences about the streams that nobody publishes, for `needs` of `health`."""
    sentences = []
    for name, stream in pair.streams.items():
        age_s = arrivals[name].age_s
        if stream.topic is not None and (age_s is None or age_s > SILENT_S):
            absent = topics.absent(stream.topic, stream.types)
            sentences += [f"{name}: {absent}"] if absent else []
    return tuple(sentences)


INCONSISTENT = "inconsistent_rig"
"""Code of the reason that a pair does not fit the others of its vehicle."""

MOVED = "sensor_moved"
"""Code of the reason that a sensor of the pair moved, and the pair serves the extrinsic from before."""

SUSPECTED = "sensor_suspected"
"""Code of the reason that the pair does not fit the others, and a sensor of it may have moved."""


def rig_problems(rig: VehicleRig) -> dict[str, tuple[Reason, ...]]:
    """A reason for each pair to which the rig objects, by pair; pairs that fit are left out."""
    return {pair: (_reason(rig, pair, objection),) for pair, objection in rig_alarms(rig).items()}


def _reason(rig: VehicleRig, pair: str, objection: RigAlarm) -> Reason:
    edge = rig.graph.edge[pair]
    if objection is RigAlarm.MOVED and rig.event is not None:
        moved = " and ".join(name for name in rig.event.sensors if name in (edge.a, edge.b))
        text = f"{moved} moved, and this pair serves the extrinsic from before; a window after the move corrects it."
        return Reason(MOVED, text)
    if objection is RigAlarm.SUSPECTED:
        undecided = (one.name for one in rig.sensors if one.health is SensorHealth.UNDECIDED)
        may_be = " or ".join(name for name in undecided if name in (edge.a, edge.b))
        return Reason(
            SUSPECTED, f"{may_be} may have moved: the pairs of the vehicle are inconsistent; the next checks decide."
        )
    return Reason(INCONSISTENT, f"The pairs of the vehicle are inconsistent{_misfit(rig.joint)}.")


def _misfit(joint: JointEstimate | None) -> str:
    if joint is None:
        return ""
    odds = f"χ² {joint.chi2:.1f} at {joint.freedom} degrees of freedom, p {joint.chance:.1g}"
    if joint.left_out is not None:
        return f": its latest window does not fit those of the others, which fit each other without it ({odds})"
    if not joint.open_loops:
        return f": the latest windows of the pairs do not fit each other ({odds})"
    loop = joint.open_loops[0]
    shift = "" if not isfinite(loop.translation_m) else f" and {100.0 * loop.translation_m:.1f} cm"
    off = f"{degrees(loop.rotation_rad):.2f}°{shift}" if isfinite(loop.rotation_rad) else "more than chance"
    return f": the latest windows of {', '.join(loop.names)} should close a loop, and miss it by {off} ({odds})"


_log = logging.getLogger(__name__)

FIRST_REMINDER_S, LONGEST_REMINDER_S = 60.0, 3600.0
"""Times after which the log repeats that there is no router, s: a minute, then twice as long each time, up to an hour.
So the last screen of a log shows it, and a night without a router gives twenty lines."""


class RouterMonitor:
    """For one thread.

    Attributes:
        problem: the reason while there is no router; None while there is one.
    """

    def __init__(
        self, endpoints: Sequence[str], is_there: Callable[[], bool], now_s: Callable[[], float] = time.monotonic
    ) -> None:
        """`endpoints` are in the form that may be shown; empty if the service is the router itself."""
        self._endpoints = ", ".join(endpoints)
        self._is_there = is_there
        self._now_s = now_s
        self._seen: bool | None = None
        self._away_since_s = self._reported_s = 0.0
        self._reminder_s = FIRST_REMINDER_S
        self.problem: Reason | None = None

    def check(self) -> None:
        """Looks now. Zenoh itself tries to connect again and again, without end."""
        if not self._endpoints:
            return
        there = self._is_there()
        now_s = self._now_s()
        if there == self._seen:
            if not there and now_s - self._reported_s >= self._reminder_s:
                _log.warning(f"no router at {self._endpoints} for {now_s - self._away_since_s:.0f} s, trying again")
                self._reported_s, self._reminder_s = now_s, min(2.0 * self._reminder_s, LONGEST_REMINDER_S)
            return
        if there:
            again = "" if self._seen is None else f" again, after {now_s - self._away_since_s:.0f} s"
            _log.info(f"the router at {self._endpoints} is there{again}")
            self.problem = None
        else:
            self._away_since_s = self._reported_s = now_s
            self._reminder_s = FIRST_REMINDER_S
            away = "no router" if self._seen is None else "the router has gone: none"
            _log.warning(f"{away} at {self._endpoints}, trying again")
            text = (
                f"No router at {self._endpoints}: no frames come in and nobody is answered until there is one; "
                "`coec doctor` says what stands in the way."
            )
            self.problem = Reason("no_router", text)
        self._seen = there
