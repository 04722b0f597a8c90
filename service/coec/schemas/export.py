"""JSON Schemas of the wire models. `python -m coec.schemas.export DIR` writes them; they are committed under
`schemas/v1`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from coec.schemas import (
    checks,
    commands,
    doctor,
    evaluation,
    fleet,
    fleet_now,
    frames,
    incident,
    last_word,
    matrix,
    replies,
    rig,
    rig_state,
)
from coec.schemas.base import Message

SENT: tuple[type[Message], ...] = (
    frames.CameraFrame,
    frames.LidarFrame,
    frames.EgoMotion,
    commands.ProvenCommand,
)
"""Messages to the service; all others come from it."""

MESSAGES: tuple[type[Message], ...] = (
    *SENT,
    replies.ExtrinsicReply,
    replies.HealthReply,
    last_word.LastWord,
    replies.HistoryReply,
    replies.HistoryEntry,
    replies.EvidenceReply,
    replies.EvidenceEvent,
    replies.WindowsReply,
    replies.StatusReply,
    replies.Acknowledgement,
    replies.ErrorReply,
    replies.CalibrationResult,
    replies.CalibrationReport,
    evaluation.AlarmsReport,
    evaluation.EvaluationReport,
    evaluation.ComparisonReport,
    evaluation.ClosureReport,
    evaluation.ModelAssessment,
    matrix.MatrixReport,
    checks.CheckedDrive,
    checks.ChecksReport,
    rig.RigMovesReport,
    rig_state.RigReply,
    rig.RigDriveRow,
    rig.RigDrivesReport,
    doctor.DoctorReport,
    fleet.WindowRow,
    fleet.BatchReport,
    fleet.FleetReport,
    fleet_now.FleetNow,
    incident.IncidentReport,
)


def schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema (2020-12) of every message, by file name."""
    return {
        f"{message.__name__}.json": {
            "$schema": "https://json-schema.org/draft/2020-12/schema",
            # Validation schemas show what a sender may leave out, serialization schemas what a reply always holds.
            **message.model_json_schema(mode="validation" if message in SENT else "serialization"),
        }
        for message in MESSAGES
    }


def text(schema: dict[str, Any]) -> str:
    """The schema as it is committed."""
    return json.dumps(schema, indent=2, sort_keys=True, ensure_ascii=False) + "\n"


def main(arguments: list[str]) -> int:
    """Writes every schema into a folder, the only argument."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m coec.schemas.export DIR\n")
        return 2
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, schema in schemas().items():
        (folder / name).write_text(text(schema), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
