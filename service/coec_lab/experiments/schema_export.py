"""JSON Schemas of the wire models. `python -m coec_lab.experiments.schema_export DIR` writes them; they are committed
under `schemas/v1`."""

import json
import sys
from pathlib import Path
from typing import Any

from coec.schemas import commands, documents, frames, heartbeat, replies, rig_state
from coec.schemas.message import Message
from coec_lab.experiments import evaluation_schema, resampled_statistics, simulation_schemas

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
    heartbeat.LastWord,
    replies.HistoryReply,
    replies.HistoryEntry,
    replies.EvidenceReply,
    replies.EvidenceEvent,
    replies.WindowsReply,
    replies.StatusReply,
    commands.Acknowledgement,
    replies.ErrorReply,
    replies.CalibrationResult,
    replies.CalibrationReport,
    evaluation_schema.AlarmsReport,
    evaluation_schema.EvaluationReport,
    evaluation_schema.ComparisonReport,
    evaluation_schema.ClosureReport,
    evaluation_schema.ModelAssessment,
    resampled_statistics.ResampleReport,
    simulation_schemas.MatrixReport,
    simulation_schemas.CheckedDrive,
    simulation_schemas.ChecksReport,
    simulation_schemas.RigMovesReport,
    rig_state.RigReply,
    simulation_schemas.RigDriveRow,
    simulation_schemas.RigDrivesReport,
    documents.DoctorReport,
    documents.WindowRow,
    documents.BatchReport,
    documents.FleetReport,
    documents.FleetNow,
    documents.IncidentReport,
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
        sys.stderr.write("usage: python -m coec_lab.experiments.schema_export DIR\n")
        return 2
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for name, schema in schemas().items():
        (folder / name).write_text(text(schema), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
