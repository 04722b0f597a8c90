"""The windows of a batch: finds them from patterns, on this machine or behind URLs of a store that fsspec knows,
fetches them, and makes the rows of those without a result.

Credentials for stores travel as an argument of the processes that evaluate windows, over Ray's own connections. Ray's
runtime environment is not used for them, because Ray writes it into a log file on every node (`runtime_env_agent.log`)
as it is.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from coec import __version__
from coec.errors import SourceError, UsageError
from coec.schemas.documents import WindowRow

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


SUFFIX = ".mcap"

SUMS = "SHA256SUMS"
"""File beside windows with their hashes, as `sha256sum *.mcap` prints them. Windows that it names are checked before
use."""

MAX_SUMS_BYTES = 64 * 2**20
"""Largest such file, bytes: half a million windows."""

_SUM = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")

_DEEP = re.compile(r"(^|/)\*\*([^/]+)$")
"""Matches `**.mcap`, which shells and stores read differently. Here it means all names that end so, at any depth."""

EXTRAS = {"s3": "s3", "s3a": "s3", "gs": "gs", "gcs": "gs", "az": "az", "abfs": "az", "abfss": "az"}
"""coec's optional extra that installs the client of a store, by the scheme of the store's URLs."""


STORE_FAILURES = frozenset(
    {
        # no credentials, or refused ones: Python, botocore, google-auth, azure-core
        "PermissionError",
        "NoCredentialsError",
        "PartialCredentialsError",
        "CredentialRetrievalError",
        "TokenRetrievalError",
        "ProfileNotFound",
        "GoogleAuthError",
        "ClientAuthenticationError",
        # no connection: Python, botocore, aiohttp, azure-core
        "ConnectionError",
        "TimeoutError",
        "gaierror",
        "HTTPClientError",
        "ClientConnectionError",
        "ServiceRequestError",
    }
)
"""Classes of errors of stores' libraries that concern every window in the store, by name, because the libraries are
optional. Classes derived from them count, too."""


class StoreError(SourceError):
    """A store that cannot be used from this machine: no client package, no connection, or no valid credentials."""

    reply_code = "store_unavailable"


@dataclass(frozen=True, slots=True)
class Job:
    """A window to be judged.

    Attributes:
        url: a path, or a URL with its scheme.
        sha256: hash of the file, as `SHA256SUMS` beside it states; None: it is not stated.
    """

    url: str
    sha256: str | None = None


def jobs_of(patterns: Sequence[str]) -> list[Job]:
    """The windows that patterns name, in the order of their URLs, each once. A pattern is a path or a URL: of a file,
    of a folder (all windows in and below it), or with `*`, `?`, `[...]` and `**`.

    Raises:
        UsageError: a pattern names no window.
        SourceError: a store cannot be asked, or the hashes beside windows cannot be read.
    """
    matches: set[str] = set()
    for pattern in patterns:
        expanded = _DEEP.sub(r"\1**/*\2", pattern)
        urls = _matching_objects(expanded) if _scheme(expanded) else _matching_files(expanded)
        if not urls:
            raise UsageError(f"{pattern} names no window ({SUFFIX})")
        matches.update(urls)
    urls = sorted(matches)
    sums = {folder: _checksums(folder) for folder in sorted({_folder(url) for url in urls})}
    return [Job(url, sums[_folder(url)].get(_name(url))) for url in urls]


def stores_of(jobs: Sequence[Job]) -> frozenset[str]:
    """Kinds of stores in which windows are, each as coec's optional extra for it."""
    return frozenset(EXTRAS[scheme] for scheme in {_scheme(job.url) for job in jobs} if scheme in EXTRAS)


def is_path(url: str) -> bool:
    """Whether a URL is a path on this machine."""
    return not _scheme(url)


@contextmanager
def fetched_window(url: str) -> Iterator[Path]:
    """A window as a file on this machine, for the duration of the block.

    Raises:
        SourceError: the window cannot be fetched.
    """
    if not _scheme(url):
        yield Path(url)
        return
    with TemporaryDirectory(prefix="coec-batch-") as folder:
        path = Path(folder) / _name(url)
        with _translated_store_errors(url):
            store, object_path = _store(url)
            with store.open(object_path, "rb") as source, path.open("wb") as target:
                shutil.copyfileobj(source, target, 2**20)
        yield path


def sha256_of(path: Path) -> str:
    """Hash of a file, hexadecimal.

    Raises:
        SourceError: the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise SourceError(f"cannot read {path}: {error.strerror}") from error


def _matching_files(pattern: str) -> list[str]:
    path = Path(pattern)
    if path.is_dir():
        matches = path.rglob(f"*{SUFFIX}")
    elif not _is_pattern(pattern):
        return [pattern]  # if the file is absent, its row gets the error, as for a store
    else:
        fixed = next(index for index, part in enumerate(path.parts) if _is_pattern(part))
        matches = Path(*path.parts[:fixed]).glob(str(Path(*path.parts[fixed:])))
    return [str(path) for path in matches if path.suffix == SUFFIX and path.is_file()]


def _is_pattern(text: str) -> bool:
    return any(sign in text for sign in "*?[")


def _matching_objects(pattern: str) -> list[str]:
    with _translated_store_errors(pattern):
        store, object_path = _store(pattern)
        if not _is_pattern(object_path):
            if not store.isdir(object_path):
                return [pattern]
            object_path = f"{object_path.rstrip('/')}/**"
        return [store.unstrip_protocol(path) for path in store.glob(object_path) if path.endswith(SUFFIX)]


def _checksums(folder: str) -> dict[str, str]:
    """Hashes that a folder's `SHA256SUMS` states, by name; empty if there is no such file."""
    url = f"{folder}{SUMS}"
    try:
        if _scheme(url):
            with _translated_store_errors(url):
                store, object_path = _store(url)
                if not store.exists(object_path):
                    return {}
                text = store.cat_file(object_path, 0, MAX_SUMS_BYTES)
        else:
            with Path(url).open("rb") as stream:
                text = stream.read(MAX_SUMS_BYTES)
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise SourceError(f"cannot read {url}: {error.strerror}") from error
    entries = (_SUM.fullmatch(line) for line in text.decode(errors="replace").splitlines())
    return {line[2].removeprefix("./"): line[1].lower() for line in entries if line}


def _scheme(url: str) -> str:
    """Scheme of a URL; empty for a path."""
    scheme, colon, _ = url.partition("://")
    return scheme if colon else ""


def _folder(url: str) -> str:
    """Everything before the last name."""
    return url[: url.rfind("/") + 1]


def _name(url: str) -> str:
    return url[url.rfind("/") + 1 :]


def _store(url: str) -> tuple[Any, str]:
    """The client of the store of a URL, and the place in the store."""
    try:
        import fsspec
    except ImportError as error:
        raise StoreError(f"{url}: URLs need the optional extra `fleet`: pip install 'coec[fleet]'") from error
    try:
        store, object_path = fsspec.core.url_to_fs(url)
    except ImportError as error:
        extra = EXTRAS.get(_scheme(url))
        hint = "" if extra is None else f": pip install 'coec[{extra}]'"
        raise StoreError(f"{url}: the package that reads {_scheme(url)}:// is not installed{hint}") from error
    except ValueError as error:
        raise UsageError(f"{url}: {error}") from error
    return store, object_path


@contextmanager
def _translated_store_errors(url: str) -> Iterator[None]:
    """Turns whatever a store's library raises into a `SourceError`, because these libraries share no error class. A
    failure that concerns the whole store becomes a `StoreError`."""
    try:
        yield
    except (SourceError, UsageError):
        raise
    except Exception as error:
        where = urlsplit(url)
        text = f"{where.scheme}://{where.hostname or ''}{where.path}: {type(error).__name__}: {redacted(str(error))}"
        names = {kind.__name__ for kind in type(error).__mro__}
        raise (SourceError(text) if names.isdisjoint(STORE_FAILURES) else StoreError(text)) from error


def empty_row(job: Job, versions: dict[str, str]) -> WindowRow:
    """The row of a window of which nothing is known yet."""
    return WindowRow(url=job.url, sha256=None, bytes=None, vehicle="", seconds=0.0, cpu_s=0.0, versions=versions)


def failed_row(row: WindowRow, code: str, text: str) -> WindowRow:
    """A row that says why there is no result."""
    return row.model_copy(update={"result": None, "decided": None, "error_code": code, "error": text})


def lost_row(job: Job, code: str, text: str) -> WindowRow:
    """The row of a window whose process ended."""
    return failed_row(empty_row(job, {"coec": __version__}), code, text)
