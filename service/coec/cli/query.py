"""`coec query`: asks a running service."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from coec.adapters.files import output
from coec.adapters.tls.conversation import Credentials, Speaker
from coec.adapters.zenoh.bus import JSON, MSGPACK
from coec.adapters.zenoh.client import (
    Reply,
    Way,
    ask,
    ask_one,
    connected_by,
    is_alive,
    key_expression,
    myself,
    nobody,
    patience_ms,
    single_key,
)
from coec.adapters.zenoh.proven import give
from coec.adapters.zenoh.settings import connected_of
from coec.adapters.zenoh.settings_file import credentials_in, read_settings
from coec.adapters.zenoh.window_fetch import fetch_window
from coec.cli.commands.query import Options
from coec.config import Config, ZenohConfig, load_config
from coec.errors import DecodeError, NotFoundError, UsageError
from coec.reports import console, replies
from coec.schemas.base import from_json, json_value
from coec.schemas.commands import CANDIDATE, NAMES, REASON, RELEASE, SENSOR, TO, arguments_of
from coec.schemas.keys import RIG, VERSION_CHUNK, Keys
from coec.schemas.replies import Acknowledgement, StatusReply
from coec.untrusted import Untrusted

VEHICLE_KEYS = ("status", "rig", "config", "metrics")
PAIR_KEYS = ("extrinsic", "health", "history", "windows", "evidence")
PLAIN_KEYS = (*PAIR_KEYS, "overlay", *VEHICLE_KEYS)
WITH_ARGUMENT = {"windows": "ID", "evidence": "ID", "command": "NAME"}
JPEG = "image/jpeg"
PATIENCE_S = 60.0
"""How long to wait for a window of which no piece arrives; what has arrived is kept for the next attempt."""

OF_PAIR = re.compile(r"(?P<pair>[A-Za-z0-9_.-]{1,64})-\d{1,19}(\.snippet)?", re.ASCII)
"""Names of windows, snippets and red events: their pair, and a time in nanoseconds."""

PICTURE_KEYS = ("overlay", "evidence")
"""Keys whose answer may be a picture, for `--output`."""


@dataclass(frozen=True, slots=True)
class Asked:
    """Which service is asked, and how its router is reached. `credentials` of the session prove commands; None: the
    session has none."""

    vehicle: str
    prefix: str
    way: Way
    credentials: Credentials | None = None


def asked_of(
    config: Path | None,
    vehicle: str | None,
    prefix: str | None,
    connect: str | None,
    zenoh_file: Path | None = None,
) -> Asked:
    """The service of a configuration, or one with the default names; other given arguments take precedence.

    Raises:
        ConfigError: the configuration, or the Zenoh configuration, cannot be read.
    """
    if config is not None:
        loaded = load_config(config)
        usual_vehicle, usual_prefix, zenoh_config = loaded.vehicle, loaded.prefix, loaded.zenoh
    else:
        named = Config.model_fields
        usual_vehicle, usual_prefix, zenoh_config = named["vehicle"].default, named["prefix"].default, ZenohConfig()
    file = zenoh_file or zenoh_config.file
    settings = None if file is None else read_settings(file)
    endpoints = () if settings is None else connected_of(settings)
    return Asked(
        usual_vehicle if vehicle is None else vehicle,
        usual_prefix if prefix is None else prefix,
        Way((endpoints or zenoh_config.router) if connect is None else (connect,), file),
        None if settings is None else credentials_in(settings),
    )


def run(options: Options) -> int:
    """Asks and prints the answers; returns 1 if a command was not accepted.

    Raises:
        UsageError: no such key, the arguments make no valid key, or the pair is ambiguous.
        NotFoundError: nobody answered.
        RemoteError: an error reply.
        NotProvenError: a command was answered by someone other than the service.
    """
    asked = asked_of(options.config, options.vehicle, options.prefix, options.connect, options.zenoh)
    keys = _keys(options, asked)
    head, _, argument = options.key.partition("/")
    whole = f"/{VERSION_CHUNK}/" in options.key
    if not whole and head == "windows" and argument:
        return _download(options, asked.way, keys, argument)
    if options.output is not None:
        return _save_picture(options, asked.way, keys, head, argument)
    payload = _payload(options)
    with connected_by(asked.way, options.timeout_s) as session:
        key, kind = _resolve(session, options, keys)
        if any(item.startswith("format=") for item in options.params or ()):
            kind = None
        replies = _answers(session, key, options, asked, payload)
        if not replies:
            raise nobody(key, service_is_there=is_alive(session, keys, options.timeout_s))
    return _show(replies, kind, options, key)


def _answers(session: zenoh.Session, key: str, options: Options, asked: Asked, payload: bytes | None) -> list[Reply]:
    """Answers to the query; a command is proven if the session has a certificate."""
    selector = _selector(key, _params(key, options))
    credentials = asked.credentials
    if not _is_command(key):
        return ask(session, selector, options.timeout_s, payload)
    if credentials is None or options.anonymous:
        return ask(session, selector, options.timeout_s, payload, myself())
    speaker = Speaker(credentials, asked.vehicle)
    encoding = MSGPACK if "format=msgpack" in (options.params or ()) else JSON
    try:
        return [give(session, selector, payload, options.timeout_s, speaker, encoding)]
    except NotFoundError:  # nobody answered; treated as for every other key
        return []


def _is_command(key: str) -> bool:
    return key.split("/")[-2] == "command"


def _keys(options: Options, asked: Asked) -> Keys:
    """The keys of the service, after checking that everything typed fits into a key.

    Raises:
        UsageError: something does not fit; the message names it.
    """
    if not math.isfinite(options.timeout_s):
        raise UsageError(f"--timeout {options.timeout_s}: give a number of seconds")
    keys = Keys(asked.prefix, asked.vehicle)
    for typed in (asked.prefix, asked.vehicle, options.key, options.pair):
        if typed is not None:
            key_expression(typed)
    head, _, argument = options.key.partition("/")
    of_several = head in WITH_ARGUMENT and argument
    if not (f"/{VERSION_CHUNK}/" in options.key or options.key in PLAIN_KEYS or of_several):
        known = ", ".join((*PLAIN_KEYS, *(f"{name}/{what}" for name, what in WITH_ARGUMENT.items())))
        raise UsageError(f"unknown key {options.key}; known: {known}, or a whole key expression with {VERSION_CHUNK}")
    return keys


def _pair_of(session: zenoh.Session, options: Options, keys: Keys, named: str) -> str:
    """The pair of a window or a red event: the given one, else the one in its name, else the vehicle's only one."""
    if options.pair is not None:
        return options.pair
    found = OF_PAIR.fullmatch(named)
    return found["pair"] if found else _only_pair(session, options, keys)


def _resolve(session: zenoh.Session, options: Options, keys: Keys) -> tuple[str, str | None]:
    """The key expression, and the kind of reply, which decides how it is printed (None: as it comes)."""
    head, _, argument = options.key.partition("/")
    if f"/{VERSION_CHUNK}/" in options.key:
        return options.key, None
    if options.key in VEHICLE_KEYS:
        return f"{keys.root}/{options.key}", options.key
    if options.key in PAIR_KEYS:
        return f"{keys.root}/{options.pair or '*'}/{options.key}", options.key
    if head == "command" and argument:
        of = options.pair or (RIG if options.sensor is not None else _only_pair(session, options, keys))
        return single_key(keys.command(of, argument)), "command"
    if head == "evidence" and argument:
        return keys.evidence_of(_pair_of(session, options, keys, argument), argument), "event"
    raise UsageError("say where to with --output FILE.jpg")


def _only_pair(session: zenoh.Session, options: Options, keys: Keys) -> str:
    """The name of the vehicle's pair, if it has one."""
    reply = ask_one(session, f"{keys.status}?format=json", options.timeout_s)
    names = [pair.name for pair in from_json(StatusReply, reply.payload).pairs]
    if len(names) != 1:
        raise UsageError(f"several pairs are served, name one with --pair: {', '.join(names)}")
    return names[0]


def _params(key: str, options: Options) -> tuple[str, ...]:
    """The given parameters; to a command is added how long its acknowledgement is awaited."""
    given = tuple(options.params or ())
    if not _is_command(key) or any(item.startswith("timeout_ms=") for item in given):
        return given
    return (*given, f"timeout_ms={patience_ms(options.timeout_s)}")


def _selector(key: str, params: tuple[str, ...]) -> str:
    for item in params:
        if "=" not in item or ";" in item:
            raise UsageError(f"--param {item}: write NAME=VALUE")
    given = params if any(item.startswith("format=") for item in params) else (*params, "format=json")
    return f"{key}?{';'.join(given)}"


def _payload(options: Options) -> bytes | None:
    """The payload of a command: as given, or made from the options that stand for its entries.

    Raises:
        UsageError: what was given does not fit the command; the message says what does.
    """
    typed = {argument.name: getattr(options, argument.name) for argument in (TO, CANDIDATE, RELEASE, REASON, SENSOR)}
    given = {name: value for name, value in typed.items() if value not in (None, False)}
    chunks = options.key.split("/")
    command = chunks[-1] if len(chunks) > 1 and chunks[-2] == "command" else None
    if command is None:
        unfit = [*(f"--{name}" for name in given), *([] if options.payload is None else ["--payload"])]
        if unfit:
            raise UsageError(f"{', '.join(unfit)}: {options.key} is no command, and takes none")
        return None
    if options.payload is not None:
        if given:
            raise UsageError(f"--payload says it all: leave --{', --'.join(given)} out, or --payload")
        try:
            return json.dumps(json.loads(options.payload), separators=(",", ":")).encode()
        except ValueError as error:
            raise UsageError(f"--payload is not JSON: {error}") from error
    if command not in NAMES:
        raise UsageError(f"there is no command {command}; known: {', '.join(NAMES)}")
    of_rig = options.pair == RIG or (options.pair is None and options.sensor is not None)
    known = {argument.name: argument.meaning for argument in arguments_of(command, for_rig=of_rig)}
    unknown = [name for name in given if name not in known]
    if unknown:
        takes = "; ".join(f"--{name}: {meaning}" for name, meaning in known.items()) or "none"
        whose = "the rig" if of_rig else "a pair"
        raise UsageError(f"--{', --'.join(unknown)}: command/{command} of {whose} does not take it. It takes {takes}")
    return json.dumps(given, separators=(",", ":")).encode() if given else None


def _show(replies: list[Reply], kind: str | None, options: Options, key: str) -> int:
    if options.as_json:
        values = [{"key": reply.key, "value": _value(reply)} for reply in replies]
        if "*" in key and f"/{VERSION_CHUNK}/" in options.key:
            console.print_json(values)
        elif len(values) > 1:
            console.print_json({"pairs": {value["key"].split("/")[-2]: value["value"] for value in values}})
        else:
            console.print_json(values[0]["value"])
    else:
        for index, reply in enumerate(sorted(replies, key=lambda reply: reply.key)):
            if index:
                console.show("")
            _render(reply, kind)
    return 0 if all(_succeeded(reply, kind) for reply in replies) else 1


def _value(reply: Reply) -> Any:
    """The payload as a JSON value, or as text if its sender does not call it JSON.

    Raises:
        DecodeError: the sender calls it JSON, but it is not.
    """
    if reply.encoding.startswith(JSON):
        return _json(reply)
    return reply.payload.decode("utf-8", errors="replace")


def _render(reply: Reply, kind: str | None) -> None:
    shown = replies.BY_KIND.get(kind or "")
    if shown is not None:
        shown(reply.payload)
    elif reply.encoding.startswith(JSON):
        console.show_json(_json(reply))
    else:
        console.show_lines(reply.payload.decode("utf-8", errors="replace").rstrip("\n"))


def _succeeded(reply: Reply, kind: str | None) -> bool:
    return kind != "command" or from_json(Acknowledgement, reply.payload).accepted


def _json(reply: Reply) -> Any:
    """The document of a reply.

    Raises:
        DecodeError: it is none; says what is wrong with it, whose it is, and what to do.
    """
    try:
        return json_value(reply.payload)
    except DecodeError as error:
        raise DecodeError(
            error.reason,
            f"the reply of {Untrusted(reply.key)} is {error}, although its sender calls it JSON ({len(reply.payload)} "
            "bytes): see the log of the service for a fault, or forbid other programs its keys with the router's rules",
        ) from error


def _save_picture(options: Options, way: Way, keys: Keys, head: str, argument: str) -> int:
    """Saves `overlay`, or `evidence/ID` with `--param overlay=before`, as a JPEG file."""
    if head not in PICTURE_KEYS or (head == "evidence") != bool(argument):
        raise UsageError(
            "--output belongs to windows/ID, overlay, and evidence/ID with --param overlay=before or after"
        )
    path = Path(str(options.output))
    if path.suffix.lower() not in ("", ".jpg", ".jpeg"):
        raise UsageError(f"{path}: the picture is a JPEG, its name must end in .jpg")
    with connected_by(way, options.timeout_s) as session:
        if head == "overlay":
            key = keys.overlay(options.pair or _only_pair(session, options, keys))
        else:
            key = keys.evidence_of(_pair_of(session, options, keys, argument), argument)
        reply = ask_one(session, _selector(single_key(key), tuple(options.params or ())), options.timeout_s)
    if reply.encoding != JPEG:
        raise UsageError("the answer is no picture: give --param overlay=before or overlay=after")
    output.replace(path, reply.payload)
    if options.as_json:
        console.print_json({"path": str(path), "size_bytes": len(reply.payload)})
    else:
        console.show(f"{path}  {len(reply.payload)} bytes")
    return 0


# --- windows/ID -----------------------------------------------------------------------------------------------


def _download(options: Options, way: Way, keys: Keys, window_id: str) -> int:
    if options.output is None:
        raise UsageError("say where to with --output FILE")
    with connected_by(way, options.timeout_s) as session, console.progress(counted=False) as bars:
        pair = _pair_of(session, options, keys, window_id)
        single_key(keys.window(pair, window_id))
        info = fetch_window(
            session,
            keys,
            pair,
            window_id,
            options.output,
            options.timeout_s,
            PATIENCE_S,
            bars.add_download(window_id),
            replaces=options.force,
        )
    if options.as_json:
        console.print_json({"path": str(options.output), **info.model_dump(mode="json")})
    else:
        console.show(f"{options.output}  {info.size_bytes} bytes, sha256 {info.sha256} verified")
    return 0
