"""The store credentials of the caller, on their way to the nodes of a cluster.

They travel as an argument of the processes that judge, over Ray's own connections. Ray's runtime environment is not
used for them, because Ray writes it into a log file on every node (`runtime_env_agent.log`) as it is.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from coec.errors import SourceError

GOOGLE = "GOOGLE_APPLICATION_CREDENTIALS"
"""Environment variable with the path of a file of credentials. Nodes get the content of the file."""

MAX_FILE_BYTES = 64 * 2**10
"""Largest such file, bytes; they have 2 to 3 kB."""


@dataclass(frozen=True, slots=True)
class _Group:
    """Environment variables that belong together, such as a key and its address.

    Attributes:
        secrets: alternatives, each a set of variables; none of them set completely: nothing is sent.
        settings: variables that are sent with them.
    """

    secrets: tuple[frozenset[str], ...]
    settings: frozenset[str]

    @property
    def names(self) -> frozenset[str]:
        return self.settings.union(*self.secrets)


# By coec's optional extra that installs the client of the store. Not sent: what names something on the caller's machine
# (AWS_PROFILE, files, addresses of its own role).
_GROUPS: Mapping[str, _Group] = {
    "s3": _Group(
        (frozenset({"AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"}),),
        frozenset(
            {
                "AWS_SESSION_TOKEN",
                "AWS_REGION",
                "AWS_DEFAULT_REGION",
                "AWS_ENDPOINT_URL",
                "AWS_ENDPOINT_URL_S3",
                "AWS_REQUEST_CHECKSUM_CALCULATION",
                "AWS_RESPONSE_CHECKSUM_VALIDATION",
            }
        ),
    ),
    "gs": _Group((frozenset({GOOGLE}),), frozenset({"GOOGLE_CLOUD_PROJECT"})),
    "az": _Group(
        (
            frozenset({"AZURE_STORAGE_CONNECTION_STRING"}),
            frozenset({"AZURE_STORAGE_ACCOUNT_KEY"}),
            frozenset({"AZURE_STORAGE_SAS_TOKEN"}),
            frozenset({"AZURE_STORAGE_CLIENT_SECRET"}),
            frozenset({"AZURE_CLIENT_SECRET"}),
        ),
        frozenset(
            {
                "AZURE_STORAGE_ACCOUNT_NAME",
                "AZURE_STORAGE_CLIENT_ID",
                "AZURE_STORAGE_TENANT_ID",
                "AZURE_CLIENT_ID",
                "AZURE_TENANT_ID",
            }
        ),
    ),
}


@dataclass(frozen=True, slots=True, repr=False)
class StoreCredentials:
    """Credentials for stores, from environment variables. `repr` shows the names only.

    Attributes:
        values: value of each variable; None: it is removed, because it would not fit the others.
        google: content of the file that `GOOGLE_APPLICATION_CREDENTIALS` names; None: there is none.
    """

    values: Mapping[str, str | None]
    google: bytes | None = None

    def __repr__(self) -> str:
        """The names of the variables, without values."""
        return f"StoreCredentials({', '.join(sorted(self.names))})"

    @property
    def names(self) -> Collection[str]:
        """Names of the variables that are sent."""
        return [name for name, value in self.values.items() if value is not None] + [GOOGLE] * (self.google is not None)

    @classmethod
    def from_environment(cls, stores: Collection[str], environment: Mapping[str, str]) -> StoreCredentials:
        """The credentials for these kinds of stores (`s3`, `gs`, `az`). If the environment has none for a store,
        nothing is sent for it: then each node uses its own, such as the role of its machine.

        Raises:
            SourceError: the file of Google's credentials cannot be read.
        """
        values: dict[str, str | None] = {}
        google = None
        for store in stores:
            group = _GROUPS[store]
            if not any(all(environment.get(name) for name in secret) for secret in group.secrets):
                continue
            values.update({name: environment.get(name) or None for name in group.names})
            path = values.pop(GOOGLE, None)
            if path is not None:
                google = _credential_file(Path(path))
        return cls(values, google)

    def install(self) -> None:
        """Sets the variables in this process. Google's file is kept in memory only, and is gone with the process."""
        for name, value in self.values.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if self.google is not None:
            descriptor = os.memfd_create("credentials")
            with open(descriptor, "wb", closefd=False) as file:
                file.write(self.google)
            os.environ[GOOGLE] = f"/proc/self/fd/{descriptor}"


def _credential_file(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_FILE_BYTES + 1)
    except OSError as error:
        raise SourceError(f"cannot read {path} ({GOOGLE}): {error.strerror}") from error
    if len(content) > MAX_FILE_BYTES:
        raise SourceError(f"{path} ({GOOGLE}) is larger than {MAX_FILE_BYTES} bytes: no file of credentials")
    return content


def redacted(text: str) -> str:
    """A text in which no value of a secret variable of this process occurs."""
    secret = {name for group in _GROUPS.values() for names in group.secrets for name in names}
    for name in secret | {"AWS_SESSION_TOKEN"}:
        value = os.environ.get(name, "")
        if len(value) >= 8 and name != GOOGLE:
            text = text.replace(value, f"[{name}]")
    return text
