"""Secrets in a configuration, wherever one can stand, and a search for them in all that the service says and writes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import zenoh
from mcap.reader import make_reader

from coec.config import SenderConfig, load_config
from coec.reports.commented_yaml import commented_yaml
from coec.schemas.keys import Keys
from e2e.processes import PATIENCE_S, Router, Service
from support.router import TestAuthority

IN_FILE, REACHED, AWAY, USER = (f"PLANTED{name}c2VjcmV0" for name in ("File", "Reached", "Away", "User"))


def plant(config: Path, router: Router, authority: TestAuthority) -> list[bytes]:
    """Write secrets into a configuration: what to search for."""
    loaded = load_config(config)
    file = config.with_name("zenoh.json5")
    file.write_text(json.dumps({"transport": {"link": {"tls": {"connect_private_key_base64": IN_FILE}}}}))
    nobody = "127.0.0.1:1"
    connect = (
        f"{router.endpoint}#password={REACHED}",
        f"tls/{nobody}#connect_private_key_base64={AWAY}",
        f"ws/user:{USER}@{nobody}",
    )
    planted = loaded.model_copy(
        update={
            "zenoh": loaded.zenoh.model_copy(update={"connect": connect, "file": file}),
            "authority": authority.of_service(SenderConfig(name="operator"), anonymous="always"),
        }
    )
    config.write_text(commented_yaml(planted))
    keys = [path.read_text().splitlines() for path in authority.folder.glob("*-key.pem")]
    # What is in a key besides its frame; one line is as long as chance makes certain.
    return [text.encode() for text in (IN_FILE, REACHED, AWAY, USER, *(lines[1] for lines in keys))]


def reported(running: Service) -> Iterator[bytes]:
    """All that the service answers: right questions, in both formats, and wrong ones."""
    keys: Keys = running.keys
    pair = running.pair
    known = [keys.status, keys.config, keys.metrics, *(f"{keys.root}/{pair}/{name}" for name in _of_pair(running))]
    wrong = [f"{keys.root}/none/health", f"{keys.root}/{pair}/nonsense", keys.command(pair, "nonsense")]
    for key in (*known, *wrong, f"{keys.root}/**"):
        for parameters in ("", "?format=json", "?nonsense=1"):
            for reply in running.session.get(f"{key}{parameters}", timeout=PATIENCE_S):
                sample = reply.ok or reply.err
                assert isinstance(sample, zenoh.Sample | zenoh.ReplyError)
                yield sample.payload.to_bytes()


def _of_pair(running: Service) -> Iterator[str]:
    yield from ("extrinsic", "health", "history", "windows", "evidence", "overlay", "command/hold")
    for window in running.windows():
        yield f"windows/{window['window_id']}"
    for event in running.query(running.keys.evidence(running.pair))["events"]:
        yield f"evidence/{event['event_id']}"


def written(folder: Path) -> Iterator[bytes]:
    """All that the service wrote below a folder: files as they are, and what is packed in windows."""
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            yield path.read_bytes()
        if path.suffix == ".mcap":
            yield from _packed(path)


def _packed(path: Path) -> Iterator[bytes]:
    with path.open("rb") as stream:
        reader = make_reader(stream)
        for _, channel, message in reader.iter_messages():
            yield json.dumps(channel.metadata).encode()
            yield message.data
        for attachment in reader.iter_attachments():
            yield attachment.data
        for metadata in reader.iter_metadata():
            yield json.dumps(metadata.metadata).encode()
