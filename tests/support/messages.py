"""Messages of a service that does not run: its status, the heartbeat of a pair, and the reply of a rig whose LiDAR
moved.
"""

from __future__ import annotations

from typing import Any

import msgpack

from coec.schemas.heartbeat import LastWord
from coec.schemas.message import to_msgpack
from coec.schemas.replies import Reason, StatusReply, StorageStatus, Transform, WorkerStatus
from coec.schemas.rig_state import (
    JointPair,
    JointReply,
    OpenLoop,
    RigCorrection,
    RigMove,
    RigReply,
    SensorKind,
    SensorMove,
    SensorReply,
    SensorState,
)

NS = 1_000_000_000
UNIT = Transform(
    matrix=((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
    translation_m=(0.0, 0.0, 0.0),
    quaternion_xyzw=(0.0, 0.0, 0.0, 1.0),
)
MOVE = SensorMove(by=(0.0, 1.0, 0.0, 0.01, 0.0, 0.0), sigma=(0.05, 0.05, 0.1, 0.01, 0.01, 0.01))


def sensor_reply(name: str, kind: SensorKind, state: SensorState, **more: Any) -> SensorReply:
    """A sensor of the pairs `front` and `left`, or of one of them."""
    fields: dict[str, Any] = {
        "probability": 0.01,
        "since_ns": 4 * NS,
        "moved": None,
        "pairs": ("front", "left") if kind == "lidar" else (name,),
        "reasons": (Reason(code="fits", text=f"The checked pairs fit without a move of {name}."),),
    }
    return SensorReply(name=name, kind=kind, state=state, **{**fields, **more})


def moved_lidar_sensor() -> SensorReply:
    """It turned by a degree."""
    why = (Reason(code="moved", text="It moved by 1.00°: measured by front, left; all else fits (99.8 %)."),)
    return sensor_reply("roof", "lidar", "lidar_moved", probability=0.998, moved=MOVE, reasons=why)


def joint_reply(**more: Any) -> JointReply:
    """Of two pairs, the second put there by the first; a loop that does not close."""
    pairs = tuple(
        JointPair(
            pair=name, camera=name, lidar="roof", measured=name == "front", camera_from_lidar=UNIT, sigma=(0.05,) * 6,
            covariance=((0.0,) * 6,) * 6, step=(0.0, 1.25, 0.0, 0.0, 0.0, 0.0),
        )
        for name in ("front", "left")
    )  # fmt: skip
    loop = OpenLoop(names=("front", "left", "bar"), rotation_deg=0.8, translation_m=0.05, p_value=1e-6)
    fields: dict[str, Any] = {
        "stamp_ns": 9 * NS, "pairs": pairs, "chi2": 55.0, "freedom": 6, "p_value": 1e-6, "consistent": False,
        "left_out": None, "open_loops": (loop,), "widened": 3.0,
    }  # fmt: skip
    return JointReply(**{**fields, **more})


def moved_lidar_reply(**more: Any) -> RigReply:
    """The LiDAR of two cameras moved, and was put right."""
    sensors = (
        sensor_reply("front", "camera", "calibrated"),
        sensor_reply("left", "camera", "undecided"),
        moved_lidar_sensor(),
    )
    correction = RigCorrection(stamp_ns=9 * NS, from_ns=24 * NS, sensors=("roof",), pairs=("front", "left"))
    move = RigMove(sensors=("roof",), since_ns=8 * NS, stepped_ns=4 * NS, over_ns=9 * NS, by={"roof": MOVE})
    fields: dict[str, Any] = {
        "vehicle": "shuttle-7", "stamp_ns": 10 * NS, "sensors": sensors, "nobody": 0.002, "disturbed": {"front": 0.0},
        "joint": joint_reply(), "correction": correction, "move": move,
        "looks": {"front": 5, "left": 4}, "losses": {"late": 2},
    }  # fmt: skip
    return RigReply(**{**fields, **more})


def reply_before_checks() -> RigReply:
    """Before anything was looked at."""
    why = (Reason(code="one_pair", text="One pair cannot distinguish a move of its camera from one of its LiDAR."),)
    sensors = (sensor_reply("roof", "lidar", "unknown", probability=None, since_ns=None, reasons=why),)
    nothing: dict[str, Any] = dict.fromkeys(("stamp_ns", "nobody", "joint", "correction", "move"))
    return moved_lidar_reply(sensors=sensors, reasons=why, losses={}, **nothing)


SENT_NS = 1_700_000_000_000_000_000


def heartbeat(vehicle: str = "vehicle", pair: str = "front", **fields: Any) -> LastWord:
    """Of a healthy pair of a vehicle that runs; `told` is what is otherwise."""
    return LastWord(
        **{
            "vehicle": vehicle,
            "pair": pair,
            "said_ns": SENT_NS,
            "period_s": 60.0,
            "service": "running",
            "version": "1.0",
            "config_hash": "0123456789abcdef",
            "state": "healthy",
            "level": 0,
            "reasons": (),
            "since_ns": SENT_NS - 10**12,
            "age_s": 4.0,
            "drift": (0.01, -0.02, 0.03, 0.001, 0.002, -0.003),
            "drift_sigma": (0.01, 0.01, 0.02, 0.004, 0.004, 0.005),
            "provenance": "commissioned",
            "status": "accepted",
            "correction": (0.1, 0.2, 0.3, 0.01, 0.02, 0.03),
            "sigma": (0.02, 0.02, 0.04, 0.01, 0.01, 0.02),
            "held": False,
            "windows": 12,
            "event": None,
            **fields,
        }
    )


def packed_heartbeat(message: LastWord, **wrong: Any) -> bytes:
    """As it travels; `wrong` is written over it, whatever the model says of that."""
    document = msgpack.unpackb(to_msgpack(message))
    data: bytes = msgpack.packb({**document, **wrong})
    return data


def status_reply(**fields: Any) -> StatusReply:
    """Of a service that runs without pairs and has nothing to do; `told` is what is otherwise."""
    return StatusReply(
        **{
            "version": "0",
            "vehicle": "vehicle",
            "state": "running",
            "started_ns": 0,
            "uptime_s": 1.0,
            "config_hash": "0",
            "pairs": (),
            "worker": WorkerStatus(state="idle"),
            "storage": StorageStatus(bytes_used=0, bytes_free=0),
            **fields,
        }
    )
