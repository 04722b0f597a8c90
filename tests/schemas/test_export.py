"""The committed JSON Schemas are those of the models."""

from pathlib import Path

from coec_lab.experiments.schema_export import main, schemas, text

EGO_REQUIRED = ("stamp_ns", "frame_id", "linear_mps", "angular_radps")
COMMITTED = Path(__file__).resolve().parents[2] / "schemas" / "v1"


def test_the_committed_schemas_equal_the_models() -> None:
    committed = {path.name: path.read_text(encoding="utf-8") for path in COMMITTED.glob("*.json")}

    assert committed == {name: text(schema) for name, schema in schemas().items()}, (
        "run: PYTHONPATH=service python -m coec_lab.experiments.schema_export schemas/v1"
    )


def test_the_command_writes_every_schema(tmp_path: Path) -> None:
    assert main([str(tmp_path / "new")]) == 0

    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == sorted(schemas())


def test_the_command_wants_one_folder() -> None:
    assert main([]) == 2


def test_optional_fields_of_frames_may_be_left_out_and_those_of_replies_are_always_there() -> None:
    assert set(schemas()["EgoMotion.json"]["required"]) == set(EGO_REQUIRED)
    assert "pending" in schemas()["ExtrinsicReply.json"]["required"]
