"""The pages on communication: keys with their parameters and answers, and the models of all messages."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

import coec
import coec_lab
from coec.schemas import commands, heartbeat, replies, rig_state
from coec.schemas import keys as grammar
from coec.schemas.keys import Keys
from coec.service.api import authorization
from coec_lab.experiments.schema_export import SENT, schemas
from generate.markdown import WRITTEN, code, prose, table

KEYS = """\
# Keys

{written}
`<prefix>/@v1/<vehicle>/<pair>/…`, by default `coec/@v1/vehicle/…`. A chunk that begins with `@` is not matched by `**`.
Answers are msgpack of the [models](schemas.md), with `?format=json` JSON; the encoding is always set. What cannot be
answered is an error reply with `code` and `message`. `coec query` asks for all of this from a terminal.

{keys}
## Parameters

Behind the `?` of a query, with `;` between them. One that is unknown, doubled or malformed is refused as `bad_request`.

{parameters}
## Commands

Every command is acknowledged: carried out, or refused and why. A payload is a map in JSON or msgpack, of at most
{max_payload} bytes, and may be left out. A command for `rig` is for all pairs, or for those of the one sensor that
`sensor` names; `to` is not for a rig, as other pairs have other windows. `coec query command/NAME --payload JSON`
gives one, with `--zenoh FILE` and a proof of who gives it ([security](security.md#commands)).

All take {common}.

{commands}
## Error codes

{errors}
Refusals of a command have codes of their own in its acknowledgement, and a router's refusal is silence
([security](security.md#denied-queries)).
"""

SCHEMAS = """\
# Messages

{written}
What is sent to the service, what it answers, and what commands print with `--json`. The same as JSON Schema (2020-12)
is in `schemas/v1/`. Readers ignore fields that they do not know; a field that changes its meaning or goes away needs
`@v2` in the keys. In the column *type*, `?` marks what a sender may leave out.

{sections}"""


@dataclass(frozen=True)
class _Resource:
    """What a key answers, and the function that reads its parameters."""

    answer: str
    parser: Callable[[str], Any] | Callable[..., Any] | None = None


def _model(model: type) -> str:
    return f"[`{model.__name__}`](schemas.md#{model.__name__.lower()})"


RESOURCES: Mapping[str, _Resource] = {
    "status": _Resource(_model(replies.StatusReply), grammar.parse_selector),
    "metrics": _Resource("OpenMetrics text ([metrics](metrics.md))"),
    "config": _Resource(
        "the configuration as JSON or msgpack ([configuration](configuration.md))", grammar.parse_selector
    ),
    "rig": _Resource(_model(rig_state.RigReply), grammar.parse_selector),
    "last": _Resource(_model(heartbeat.LastWord), grammar.parse_selector),
    "extrinsic": _Resource(_model(replies.ExtrinsicReply), grammar.parse_extrinsic_selector),
    "health": _Resource(_model(replies.HealthReply), grammar.parse_selector),
    "history": _Resource(_model(replies.HistoryReply), grammar.parse_history_selector),
    "windows": _Resource(_model(replies.WindowsReply), grammar.parse_selector),
    "window": _Resource("bytes of an MCAP file", grammar.parse_range_selector),
    "overlay": _Resource("JPEG", grammar.parse_overlay_selector),
    "evidence": _Resource(_model(replies.EvidenceReply), grammar.parse_selector),
    "evidence_of": _Resource(f"{_model(replies.EvidenceEvent)}, or a JPEG", grammar.parse_evidence_selector),
    "command": _Resource(_model(commands.Acknowledgement), grammar.parse_command_selector),
    "alive": _Resource("liveliness token"),
    "claims": _Resource("liveliness tokens; each answered, without content, by its daemon"),
}
"""Resources by the method of `Keys` that builds the key."""

COMMANDS: Mapping[str, str] = {
    "calibrate": "the open window ends now and is solved, if it has pairs enough; else the latest one is solved again",
    "apply": "the estimate that waits becomes what is served; with `candidate`, only if it is this one (window id, "
    "or the start of its sha256 in `extrinsic`)",
    "rollback": "what was served before is served again, or what window `to` gave (its id, or the start of a sha256)",
    "reset": "the workshop calibration is served; the next accepted window may move it",
    "commission": "the limits of the rig are learned from the windows that agree with what is served",
    "hold": "what is served stays as it is, whatever is found, until `release` ends that",
}
"""What each command does."""

KINDS: Mapping[type, str] = {str: "text", bool: "true or false"}

INSTEAD = {"pair": "<pair>", "window_id": "<id>", "event_id": "<id>", "name": "<name>"}
"""Placeholders for the arguments of those methods."""


def keys_page() -> str:
    """Markdown: every key, parameter, command and error code."""
    built = Keys("<prefix>", "<vehicle>")
    rows = []
    for name, resource in RESOURCES.items():
        member = inspect.getattr_static(Keys, name)
        if isinstance(member, property):
            key, says = getattr(built, name), member.__doc__
        else:
            arguments = [INSTEAD[one] for one in list(inspect.signature(member).parameters)[1:]]
            key, says = getattr(built, name)(*arguments), member.__doc__
        rows.append((code(key.replace("<prefix>/@v1/<vehicle>/", "…/")), prose(says or ""), resource.answer))
    parsers = [(one, of.parser) for one, of in RESOURCES.items() if of.parser is not None]
    parameters = [
        (
            f"`{name}`".replace("`window`", "`windows/<id>`").replace("`evidence_of`", "`evidence/<id>`"),
            _grammar(parser),
        )
        for name, parser in parsers
    ]
    return KEYS.format(
        written=WRITTEN,
        keys=table(("key", "kind", "answer"), rows),
        parameters=table(("of", "parameters"), parameters),
        common="; and ".join(map(_argument, (commands.REASON, commands.SENSOR))),
        commands=table(
            ("command", "also takes", "what it does"),
            [(code(name), _arguments(name), COMMANDS[name]) for name in commands.COMMAND_NAMES],
        ),
        max_payload=authorization.MAX_PAYLOAD,
        errors=table(
            ("code", "when"), [(code(name), prose("; or: ".join(when))) for name, when in sorted(_errors().items())]
        ),
    )


def schemas_page() -> str:
    """Markdown: every message, its fields and those of its parts."""
    parts: dict[str, tuple[dict[str, Any], str]] = {}
    for name, schema in schemas().items():
        title = name.removesuffix(".json")
        way = "Sent to the service." if title in {one.__name__ for one in SENT} else ""
        parts[title] = (schema, way)
        for part, body in schema.get("$defs", {}).items():
            parts.setdefault(part, (body, ""))
    # What is no message with fields (a matrix, a name from a list) is described where it is used.
    shapes = {name: schema for name, (schema, _) in parts.items() if "properties" not in schema}
    sections = [
        _message(name, schema, way, shapes) for name, (schema, way) in sorted(parts.items()) if name not in shapes
    ]
    return SCHEMAS.format(written=WRITTEN, sections="\n".join(sections))


def _message(name: str, schema: dict[str, Any], way: str, shapes: Mapping[str, dict[str, Any]]) -> str:
    needed = set(schema.get("required", ()))
    rows = [
        (code(field), _type(body, shapes) + ("" if field in needed else " ?"), prose(body.get("description", "")))
        for field, body in schema["properties"].items()
    ]
    about = " ".join(filter(None, (prose(schema.get("description", "")), way)))
    return f"## {name} {{#{name.lower()}}}\n\n{about}\n\n{table(('field', 'type', 'what it is'), rows)}"


def _type(body: dict[str, Any], shapes: Mapping[str, dict[str, Any]]) -> str:
    """The type of a field in a few words."""
    if "$ref" in body:
        name = body["$ref"].rpartition("/")[2]
        return _type(shapes[name], shapes) if name in shapes else f"[{name}](#{name.lower()})"
    if "anyOf" in body:
        return " or ".join(dict.fromkeys(_type(one, shapes) for one in body["anyOf"]))
    if "const" in body:
        return code(body["const"])
    if "enum" in body:
        return ", ".join(map(code, body["enum"]))
    if body.get("type") == "array":
        items = body.get("items") or {}
        return f"list of {_type(items, shapes)}" if items else "list"
    if body.get("type") == "object" and isinstance(body.get("additionalProperties"), dict):
        return f"{_type(body['additionalProperties'], shapes)} by name"
    return str(body.get("format") or body.get("type") or "anything")


def _arguments(command: str) -> str:
    """Arguments of this command beyond those of all commands."""
    return "; ".join(map(_argument, commands.PAIR_ARGUMENTS.get(command, ()))) or "–"


def _argument(one: commands.Argument) -> str:
    return f"`{one.name}`: {KINDS[one.kind]}, {one.meaning}"


def _grammar(parser: Callable[..., Any]) -> str:
    return (parser.__doc__ or "").partition("\n")[0].rstrip(".").replace(", each optional", "")


def _errors() -> Mapping[str, list[str]]:
    """When each error code is replied, from every class of the packages that has one. Read from the source, because
    what is imported depends on the caller."""
    codes_of: dict[str, list[str]] = {}
    packages = (Path(package) for package in (*coec.__path__, *coec_lab.__path__))
    for path in sorted(path for package in packages for path in package.rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        if "reply_code = " not in source:
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ClassDef):
                codes = [
                    one.value.value for one in node.body if _names_code(one) and isinstance(one.value, ast.Constant)
                ]
                for name in codes:
                    codes_of.setdefault(str(name), []).append(_first(ast.get_docstring(node) or ""))
    return codes_of


def _names_code(statement: ast.stmt) -> TypeGuard[ast.Assign]:
    return isinstance(statement, ast.Assign) and any(
        isinstance(target, ast.Name) and target.id == "reply_code" for target in statement.targets
    )


def _first(text: str) -> str:
    return " ".join(text.split()).partition(". ")[0].rstrip(".")
