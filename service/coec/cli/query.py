"""`coec query`: queries a running service, and sends it commands."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coec.cli.options import Connect, Json, Prefix, ServiceAddress, ServiceConfig, Vehicle, service_address, suggesting
from coec.errors import DecodeError, NotFoundError, UsageError
from coec.reports import console
from coec.schemas.keys import RIG, VERSION_CHUNK, Keys
from coec.untrusted import Untrusted

if TYPE_CHECKING:
    import zenoh

    from coec.io.zenoh.query_client import Reply, RouterAddress
    from coec.schemas.keys import Keys

VEHICLE_KEYS = ("status", "rig", "config", "metrics")

PAIR_KEYS = ("extrinsic", "health", "history", "windows", "evidence")

PLAIN_KEYS = (*PAIR_KEYS, "overlay", *VEHICLE_KEYS)

WITH_ARGUMENT = {"windows": "ID", "evidence": "ID", "command": "NAME"}

JPEG = "image/jpeg"

PATIENCE_S = 60.0
"""How long to wait for a window of which no piece arrives; what has arrived is kept for the next attempt."""

OF_PAIR = re.compile(r"(?P<pair>[A-Za-z0-9_.-]{1,64})-\d{1,19}(\.snippet)?", re.ASCII)
"""Names of windows, snippets and incidents: their pair, and a time in nanoseconds."""

PICTURE_KEYS = ("overlay", "evidence")
"""Keys whose answer may be a picture, for `--output`."""


@dataclass(frozen=True, slots=True)
class Key:
    """What can be queried. `parameters` are those of `--param`, in addition to `format`."""

    key: str
    answer: str
    parameters: str = ""


KEYS = (
    Key("extrinsic", "where the camera is, with sigma", "format=tf, urdf, ... as `coec export`; parent, child"),
    Key("health", "state, reasons, figures and their limits"),
    Key("history", "past results, and who changed what", "since=NS, until=NS, limit=COUNT"),
    Key("windows", "recorded windows and snippets"),
    Key("windows/ID", "one of them, into --output FILE, its sha256 verified"),
    Key("overlay", "picture of the latest window, into --output FILE.jpg", "at=nominal, window=ID"),
    Key("evidence", "stored incidents"),
    Key("evidence/ID", "one of them; a picture of it with --output FILE.jpg", "overlay=before, overlay=after"),
    Key("rig", "all sensors of the vehicle together"),
    Key("status", "the service itself: streams, worker, budget, problems"),
    Key("config", "its effective configuration, without secrets"),
    Key("metrics", "OpenMetrics text"),
    Key("command/NAME", "calibrate, apply, rollback, reset, commission, hold", "timeout_ms=COUNT"),
)
"""In the order of the help text."""


@dataclass(frozen=True, slots=True)
class Request:
    """What is requested: a key, of one pair or sensor, with the parameters of `--param`."""

    key: str
    pair: str | None
    sensor: str | None
    params: tuple[str, ...]
    timeout_s: float

    @property
    def is_whole(self) -> bool:
        """Whether the key is a whole key expression."""
        return f"/{VERSION_CHUNK}/" in self.key


def _typable() -> Iterable[str]:
    """Keys that a shell suggests; commands each by name."""
    from coec.schemas.commands import COMMAND_NAMES

    plain = (each.key for each in KEYS if "/" not in each.key)
    return (*plain, "windows/", "evidence/", *(f"command/{name}" for name in COMMAND_NAMES))


KeyArgument = Annotated[
    str,
    typer.Argument(
        help="One of the keys above, or a whole key expression with @v1 in it.",
        metavar="KEY",
        autocompletion=suggesting(_typable),
        show_default=False,
    ),
]
Pair = Annotated[
    str | None, typer.Option(help="Pair to query; default: all. A command needs it if there are several pairs.")
]
SessionCredentials = Annotated[
    Path | None,
    typer.Option(
        help="Zenoh configuration (JSON5) to connect with; its certificate authenticates commands.",
        metavar="FILE",
    ),
]
Anonymous = Annotated[bool, typer.Option("--anonymous", help="Send a command without authentication.")]
Params = Annotated[
    list[str] | None,
    typer.Option("--param", help="Parameter of the query, for example limit=5; repeatable.", metavar="K=V"),
]
RollbackTo = Annotated[
    str | None,
    typer.Option(help="For command/rollback: window or sha256 from `query history` to serve again.", metavar="HASH"),
]
Candidate = Annotated[
    str | None,
    typer.Option(
        help="For command/apply: window or sha256 of the candidate from `query extrinsic`; another one is refused.",
        metavar="HASH",
    ),
]
Release = Annotated[bool, typer.Option("--release", help="For command/hold: end the hold.")]
Reason = Annotated[
    str | None,
    typer.Option(
        help="For any command: the reason. It appears in `query history`, and for a hold also in extrinsic and health.",
        metavar="TEXT",
    ),
]
Sensor = Annotated[
    str | None,
    typer.Option(help="For any command: apply it to all pairs of this sensor of the rig.", metavar="NAME"),
]
Payload = Annotated[
    str | None, typer.Option(help="Payload of a command as JSON, instead of these options.", metavar="JSON")
]
OutputFile = Annotated[
    Path | None,
    typer.Option(
        help="File to write, byte for byte as it was sent: windows/ID with its sha256 verified, overlay, or a "
        "picture of evidence/ID.",
        metavar="FILE",
    ),
]
ForceOption = Annotated[bool, typer.Option("--force", help="Replace a FILE that holds something else than the window.")]


def query(
    key: KeyArgument,
    pair: Pair = None,
    config: ServiceConfig = None,
    vehicle: Vehicle = None,
    prefix: Prefix = None,
    connect: Connect = None,
    zenoh: SessionCredentials = None,
    anonymous: Anonymous = (False),
    params: Params = None,
    to: RollbackTo = None,
    candidate: Candidate = None,
    release: Release = False,
    reason: Reason = None,
    sensor: Sensor = None,
    payload: Payload = None,
    timeout_s: Annotated[
        float, typer.Option("--timeout", help="Seconds to wait for the router and for the answer.", min=0.01)
    ] = 5.0,
    output: OutputFile = None,
    force: ForceOption = False,
    as_json: Json = False,
) -> int:
    from coec.io.zenoh.query_client import connected_by, is_alive, no_reply_error

    address = service_address(config, vehicle, prefix, connect, zenoh)
    request = Request(key, pair, sensor, tuple(params or ()), timeout_s)
    keys = _keys(request, address)
    head, _, argument = key.partition("/")
    if not request.is_whole and head == "windows" and argument:
        return _download(request, address.way, keys, argument, output, force=force, as_json=as_json)
    if output is not None:
        return _save_picture(request, address.way, keys, output, as_json=as_json)
    arguments = {"to": to, "candidate": candidate, "release": release, "reason": reason, "sensor": sensor}
    data = _payload(request, arguments, payload)
    with connected_by(address.way, timeout_s) as session:
        selected, kind = _resolve(session, request, keys)
        if any(item.startswith("format=") for item in request.params):
            kind = None
        answers = _answers(session, selected, request, address, data, anonymous=anonymous)
        if not answers:
            raise no_reply_error(selected, service_is_there=is_alive(session, keys, timeout_s))
    _show(answers, kind, request, selected, as_json=as_json)
    return 0 if all(_succeeded(answer, kind) for answer in answers) else 1


def _answers(
    session: zenoh.Session,
    key: str,
    request: Request,
    address: ServiceAddress,
    data: bytes | None,
    *,
    anonymous: bool,
) -> list[Reply]:
    """Answers to the query; a command is authenticated if the session has a certificate."""
    from coec.io.zenoh.command_auth import CommandSender
    from coec.io.zenoh.query_client import JSON, MSGPACK, myself, query_all, send_authenticated

    selector = _selector(key, _params(key, request))
    credentials = address.credentials
    if not _is_command(key):
        return query_all(session, selector, request.timeout_s, data)
    if credentials is None or anonymous:
        return query_all(session, selector, request.timeout_s, data, myself())
    speaker = CommandSender(credentials, address.vehicle)
    encoding = MSGPACK if "format=msgpack" in request.params else JSON
    try:
        return [send_authenticated(session, selector, data, request.timeout_s, speaker, encoding)]
    except NotFoundError:  # nobody answered; treated as for every other key
        return []


def _is_command(key: str) -> bool:
    return key.split("/")[-2] == "command"


def _keys(request: Request, address: ServiceAddress) -> Keys:
    """The keys of the service, after checking that everything typed fits into a key.

    Raises:
        UsageError: something does not fit; the message names it.
    """
    from coec.io.zenoh.query_client import key_expression

    if not math.isfinite(request.timeout_s):
        raise UsageError(f"--timeout {request.timeout_s}: give a number of seconds")
    keys = Keys(address.prefix, address.vehicle)
    for typed in (address.prefix, address.vehicle, request.key, request.pair):
        if typed is not None:
            key_expression(typed)
    head, _, argument = request.key.partition("/")
    of_several = head in WITH_ARGUMENT and argument
    if not (request.is_whole or request.key in PLAIN_KEYS or of_several):
        known = ", ".join((*PLAIN_KEYS, *(f"{name}/{what}" for name, what in WITH_ARGUMENT.items())))
        raise UsageError(f"unknown key {request.key}; known: {known}, or a whole key expression with {VERSION_CHUNK}")
    return keys


def _pair_of(session: zenoh.Session, request: Request, keys: Keys, named: str) -> str:
    """The pair of a window or an incident: the given one, else the one in its name, else the vehicle's only one."""
    if request.pair is not None:
        return request.pair
    match = OF_PAIR.fullmatch(named)
    return match["pair"] if match else _only_pair(session, request, keys)


def _resolve(session: zenoh.Session, request: Request, keys: Keys) -> tuple[str, str | None]:
    """The key expression, and the kind of reply, which decides how it is printed (None: as it comes)."""
    from coec.io.zenoh.query_client import single_key

    head, _, argument = request.key.partition("/")
    if request.is_whole:
        return request.key, None
    if request.key in VEHICLE_KEYS:
        return f"{keys.root}/{request.key}", request.key
    if request.key in PAIR_KEYS:
        return f"{keys.root}/{request.pair or '*'}/{request.key}", request.key
    if head == "command" and argument:
        of = request.pair or (RIG if request.sensor is not None else _only_pair(session, request, keys))
        return single_key(keys.command(of, argument)), "command"
    if head == "evidence" and argument:
        return keys.evidence_of(_pair_of(session, request, keys, argument), argument), "event"
    raise UsageError("give the file with --output FILE.jpg")


def _only_pair(session: zenoh.Session, request: Request, keys: Keys) -> str:
    """The name of the vehicle's pair, if it has one."""
    from coec.io.zenoh.query_client import query_one
    from coec.schemas.message import from_json
    from coec.schemas.replies import StatusReply

    reply = query_one(session, f"{keys.status}?format=json", request.timeout_s)
    names = [pair.name for pair in from_json(StatusReply, reply.payload).pairs]
    if len(names) != 1:
        raise UsageError(f"several pairs are served, name one with --pair: {', '.join(names)}")
    return names[0]


def _params(key: str, request: Request) -> tuple[str, ...]:
    """The given parameters; to a command is added how long its acknowledgement is awaited."""
    from coec.io.zenoh.query_client import patience_ms

    given = request.params
    if not _is_command(key) or any(item.startswith("timeout_ms=") for item in given):
        return given
    return (*given, f"timeout_ms={patience_ms(request.timeout_s)}")


def _selector(key: str, params: tuple[str, ...]) -> str:
    for item in params:
        if "=" not in item or ";" in item:
            raise UsageError(f"--param {item}: write NAME=VALUE")
    given = params if any(item.startswith("format=") for item in params) else (*params, "format=json")
    return f"{key}?{';'.join(given)}"


def _payload(request: Request, arguments: Mapping[str, str | bool | None], payload: str | None) -> bytes | None:
    """The payload of a command: as given, or made from the request that stand for its entries.

    Raises:
        UsageError: what was given does not fit the command; the message says what does.
    """
    from coec.schemas.commands import COMMAND_NAMES, arguments_of

    given = {name: value for name, value in arguments.items() if value not in (None, False)}
    chunks = request.key.split("/")
    command = chunks[-1] if len(chunks) > 1 and chunks[-2] == "command" else None
    if command is None:
        unfit = [*(f"--{name}" for name in given), *([] if payload is None else ["--payload"])]
        if unfit:
            raise UsageError(f"{', '.join(unfit)}: {request.key} is not a command and takes no payload")
        return None
    if payload is not None:
        if given:
            raise UsageError(f"--payload is the complete payload: omit --{', --'.join(given)}, or --payload")
        try:
            return json.dumps(json.loads(payload), separators=(",", ":")).encode()
        except ValueError as error:
            raise UsageError(f"--payload is not JSON: {error}") from error
    if command not in COMMAND_NAMES:
        raise UsageError(f"there is no command {command}; known: {', '.join(COMMAND_NAMES)}")
    of_rig = request.pair == RIG or (request.pair is None and request.sensor is not None)
    known = {argument.name: argument.meaning for argument in arguments_of(command, for_rig=of_rig)}
    unknown = [name for name in given if name not in known]
    if unknown:
        takes = "; ".join(f"--{name}: {meaning}" for name, meaning in known.items()) or "none"
        whose = "the rig" if of_rig else "a pair"
        raise UsageError(f"--{', --'.join(unknown)}: command/{command} of {whose} does not take it. It takes {takes}")
    return json.dumps(given, separators=(",", ":")).encode() if given else None


def _show(answers: list[Reply], kind: str | None, request: Request, key: str, *, as_json: bool) -> None:
    if as_json:
        values = [{"key": answer.key, "value": _value(answer)} for answer in answers]
        if "*" in key and request.is_whole:
            console.print_json(values)
        elif len(values) > 1:
            console.print_json({"pairs": {value["key"].split("/")[-2]: value["value"] for value in values}})
        else:
            console.print_json(values[0]["value"])
        return
    for index, answer in enumerate(sorted(answers, key=lambda answer: answer.key)):
        if index:
            console.show("")
        _render(answer, kind)


def _value(reply: Reply) -> Any:
    """The payload as a JSON value, or as text if its sender does not call it JSON.

    Raises:
        DecodeError: the sender calls it JSON, but it is not.
    """
    from coec.io.zenoh.query_client import JSON

    if reply.encoding.startswith(JSON):
        return _json(reply)
    return reply.payload.decode("utf-8", errors="replace")


def _render(reply: Reply, kind: str | None) -> None:
    from coec.io.zenoh.query_client import JSON
    from coec.reports import replies as tables

    shown = tables.BY_KIND.get(kind or "")
    if shown is not None:
        shown(reply.payload)
    elif reply.encoding.startswith(JSON):
        console.show_json(_json(reply))
    else:
        console.show_lines(reply.payload.decode("utf-8", errors="replace").rstrip("\n"))


def _succeeded(reply: Reply, kind: str | None) -> bool:
    from coec.schemas.commands import Acknowledgement
    from coec.schemas.message import from_json

    return kind != "command" or from_json(Acknowledgement, reply.payload).accepted


def _json(reply: Reply) -> Any:
    """The document of a reply.

    Raises:
        DecodeError: it is none; says what is wrong with it, whose it is, and what to do.
    """
    from coec.schemas.message import json_value

    try:
        return json_value(reply.payload)
    except DecodeError as error:
        raise DecodeError(
            error.reason,
            f"the reply of {Untrusted(reply.key)} is {error}, although its encoding is declared as JSON "
            f"({len(reply.payload)} bytes): see the log of the service for a fault, or forbid other programs its keys "
            "with the router's rules",
        ) from error


def _save_picture(request: Request, way: RouterAddress, keys: Keys, path: Path, *, as_json: bool) -> int:
    """Saves `overlay`, or `evidence/ID` with `--param overlay=before`, as a JPEG file."""
    from coec.io import user_files as files
    from coec.io.zenoh.query_client import connected_by, query_one, single_key

    head, _, argument = request.key.partition("/")
    if head not in PICTURE_KEYS or (head == "evidence") != bool(argument):
        raise UsageError(
            "--output belongs to windows/ID, overlay, and evidence/ID with --param overlay=before or after"
        )
    if path.suffix.lower() not in ("", ".jpg", ".jpeg"):
        raise UsageError(f"{path}: the picture is a JPEG, its name must end in .jpg")
    with connected_by(way, request.timeout_s) as session:
        if head == "overlay":
            key = keys.overlay(request.pair or _only_pair(session, request, keys))
        else:
            key = keys.evidence_of(_pair_of(session, request, keys, argument), argument)
        reply = query_one(session, _selector(single_key(key), request.params), request.timeout_s)
    if reply.encoding != JPEG:
        raise UsageError("the reply contains no picture: give --param overlay=before or overlay=after")
    files.replace_output(path, reply.payload)
    console.report(
        {"path": str(path), "size_bytes": len(reply.payload)},
        lambda: console.show(f"{path}  {len(reply.payload)} bytes"),
        as_json=as_json,
    )
    return 0


def _download(
    request: Request, way: RouterAddress, keys: Keys, window_id: str, output: Path | None, *, force: bool, as_json: bool
) -> int:
    from coec.io.zenoh.query_client import connected_by, fetch_window, single_key

    if output is None:
        raise UsageError("give the file with --output FILE")
    with connected_by(way, request.timeout_s) as session, console.progress(counted=False) as bars:
        pair = _pair_of(session, request, keys, window_id)
        single_key(keys.window(pair, window_id))
        info = fetch_window(
            session,
            keys,
            pair,
            window_id,
            output,
            request.timeout_s,
            PATIENCE_S,
            bars.add_download(window_id),
            replaces=force,
        )
    console.report(
        {"path": str(output), **info.model_dump(mode="json")},
        lambda: console.show(f"{output}  {info.size_bytes} bytes, sha256 {info.sha256} verified"),
        as_json=as_json,
    )
    return 0


def _help() -> str:
    """Every key, what it answers and its parameters, in columns, by the mark that help texts have for them."""
    width = max(len(each.key) for each in KEYS)
    rows = []
    for each in KEYS:
        rows.append(f"{each.key:{width}}  {each.answer}")
        if each.parameters:
            rows.append(f"{'':{width}}    --param {each.parameters}")
    listed = "\n".join(rows)
    several = (
        "With --json, several pairs give one document: {pairs: {NAME: answer of the pair}}; one pair, or --pair, gives "
        "its answer alone."
    )
    return f"Query a running service, or send it a command.\n\n\b\n{listed}\n\n{several}"


query.__doc__ = _help()
