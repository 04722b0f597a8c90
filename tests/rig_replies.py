"""What is said of a rig whose LiDAR moved, as a reply."""

from __future__ import annotations

from typing import Any

from coec.schemas.replies import Reason, Transform
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
        "reasons": (Reason(code="fits", text=f"The pairs that were looked at fit without a move of {name}."),),
    }
    return SensorReply(name=name, kind=kind, state=state, **{**fields, **more})


def moved_lidar_sensor() -> SensorReply:
    """It turned by a degree."""
    why = (Reason(code="moved", text="It moved by 1.00°: seen by front, left; all else fits (99.8 %)."),)
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
    why = (Reason(code="one_pair", text="One pair cannot tell its camera from its LiDAR."),)
    sensors = (sensor_reply("roof", "lidar", "unknown", probability=None, since_ns=None, reasons=why),)
    nothing: dict[str, Any] = dict.fromkeys(("stamp_ns", "nobody", "joint", "correction", "move"))
    return moved_lidar_reply(sensors=sensors, reasons=why, losses={}, **nothing)
