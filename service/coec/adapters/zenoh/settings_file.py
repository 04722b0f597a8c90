"""Reads the Zenoh configuration file (JSON5) that coec's configuration or a command names."""

from __future__ import annotations

import json
import re
from pathlib import Path

import zenoh

from coec.adapters.tls.conversation import Credentials
from coec.adapters.zenoh.endpoints import HIDDEN
from coec.errors import ConfigError, cannot_read

TLS = "transport/link/tls"

MAX_SETTINGS_BYTES = 2**20
"""Largest file; the shipped rules of a router have 8 kB."""

MAX_BRACKETS = 10_000
"""Most opening brackets of a file; the shipped rules have 90. Zenoh's reader recurses for each nested bracket and
crashes the process when the stack is used up, which happens between 32,000 and 100,000 brackets on a stack of 8 MB."""

_PLACE = re.compile(r"--> (\d+):(\d+)")
_VALUE = re.compile(r"""(?<=variant )`[^`]*`|"[^"]*"?|'[^']*'?""")


def read_settings(path: Path) -> zenoh.Config:
    """The settings in a file.

    Raises:
        ConfigError: it cannot be read, or holds no settings. The message quotes none of its values, which may be keys
            and passwords.
    """
    try:
        with path.open("rb") as stream:
            data = stream.read(MAX_SETTINGS_BYTES + 1)
        text = data.decode("utf-8")
    except OSError as error:
        raise ConfigError(cannot_read(path, error)) from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is no text in UTF-8") from None
    brackets = text.count("{") + text.count("[")
    if len(data) > MAX_SETTINGS_BYTES or brackets > MAX_BRACKETS:
        raise ConfigError(
            f"{path} is no configuration of Zenoh: it has more than {MAX_SETTINGS_BYTES} bytes, or {MAX_BRACKETS} brackets"
        )
    try:
        return zenoh.Config.from_json5(text)
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"{path} is no configuration of Zenoh (JSON5): {_harmless(str(error))}") from None


def credentials_in(settings: zenoh.Config) -> Credentials | None:
    """Files of the certificate that a session with these settings shows when it connects; None: there are none."""
    tls = json.loads(settings.get_json(TLS))
    files = [tls.get(name) for name in ("connect_certificate", "connect_private_key", "root_ca_certificate")]
    if not all(isinstance(file, str) for file in files):
        return None
    certificate, private_key, root_ca = (Path(file) for file in files)
    return Credentials(certificate, private_key, root_ca)


def _harmless(text: str) -> str:
    """Zenoh's message about a file without the file's content: the message may quote a line or a value."""
    place = _PLACE.search(text)
    if place is not None:
        return f"line {place[1]}, column {place[2]}"
    return _VALUE.sub(f'"{HIDDEN}"', text.partition(" at /")[0])
