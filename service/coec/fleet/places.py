"""Finds and fetches windows, on this machine or behind a URL of a store that fsspec knows."""

from __future__ import annotations

import hashlib
import re
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from urllib.parse import urlsplit

from coec.errors import SourceError, UsageError
from coec.fleet.credentials import redacted

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
