"""The packages that are installed because coec needs them, read from the metadata of each package."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path, PurePosixPath

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from coec.errors import NotFoundError, UsageError

NAMED: Mapping[str, str] = {
    "3-Clause BSD License": "BSD-3-Clause",
    "Apache 2.0": "Apache-2.0",
    "Apache-2.0": "Apache-2.0",
    "BSD-2-Clause": "BSD-2-Clause",
    "BSD-3-Clause": "BSD-3-Clause",
    "ISC License": "ISC",
    "MIT": "MIT",
    "MIT License": "MIT",
    "any-OSI": "any-OSI",
}
"""Texts that packages write into the field `License`, and their SPDX identifiers."""

CLASSIFIED: Mapping[str, str] = {
    "License :: OSI Approved :: Apache Software License": "Apache-2.0",
    "License :: OSI Approved :: Eclipse Public License 2.0 (EPL-2.0)": "EPL-2.0",
    "License :: OSI Approved :: ISC License (ISCL)": "ISC",
    "License :: OSI Approved :: MIT License": "MIT",
    "License :: OSI Approved :: Mozilla Public License 2.0 (MPL 2.0)": "MPL-2.0",
    "License :: OSI Approved :: Python Software Foundation License": "PSF-2.0",
}
"""Classifiers that name a single licence; `BSD License` is not here because it names a family."""

_PIN = re.compile(r"(?P<name>[A-Za-z0-9._-]+)==(?P<version>\S+)")
_HASH = re.compile(r"--hash=sha256:(?P<sha256>[0-9a-f]{64})\b")


@dataclass(frozen=True, slots=True)
class NativeLibrary:
    """A third-party shared library inside a package; `sha256` is hexadecimal."""

    file: str
    sha256: str

    @property
    def name(self) -> str:
        """The name without the packer's mark and without the version: `libavcodec`."""
        return re.sub(r"(-[0-9a-f]{8})+(?=[-.])|\.so.*", "", self.file)


@dataclass(frozen=True, slots=True)
class Package:
    """An installed package.

    Attributes:
        licence: SPDX expression; None if the package states none.
        licence_files: names of the licence texts in its metadata.
        requires: canonical names of the packages that it needs on this machine.
        native: third-party libraries inside it, whose licences are at best in its texts.
    """

    name: str
    version: str
    licence: str | None
    licence_files: tuple[str, ...]
    requires: tuple[str, ...]
    native: tuple[NativeLibrary, ...]


def installed_packages(name: str) -> dict[str, Package]:
    """A package and everything that it needs, directly or not, by canonical name in alphabetical order. Optional extras
    are included if a needed package asks for them by name.

    Raises:
        NotFoundError: the package, or one that it needs, is not installed.
    """
    packages: dict[str, Package] = {}
    waiting: list[tuple[str, frozenset[str]]] = [(name, frozenset())]
    visited: set[tuple[str, frozenset[str]]] = set()
    while waiting:
        requirement = waiting.pop()
        if requirement in visited:
            continue
        visited.add(requirement)
        try:
            metadata = distribution(requirement[0])
        except PackageNotFoundError as error:
            raise NotFoundError(
                f"the package {requirement[0]} is needed but not installed: install coec with all of them "
                "(pip install coec)"
            ) from error
        needs = list(_needs(metadata, requirement[1]))
        waiting += needs
        canonical = canonicalize_name(metadata.metadata["Name"])
        before = packages[canonical].requires if canonical in packages else ()
        requires = tuple(sorted({*before, *(canonicalize_name(need) for need, _ in needs)}))
        packages[canonical] = Package(
            name=metadata.metadata["Name"],
            version=metadata.version,
            licence=_licence(metadata),
            licence_files=tuple(metadata.metadata.get_all("License-File") or ()),
            requires=requires,
            native=tuple(_native(metadata)),
        )
    return dict(sorted(packages.items()))


def pinned_hashes(lock: Path) -> dict[tuple[str, str], tuple[str, ...]]:
    """sha256 (hexadecimal) of the archives that a requirements.lock allows, by canonical name and version.

    Raises:
        UsageError: the file cannot be read, or pins nothing.
    """
    try:
        lines = lock.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"cannot read {lock}: {error}") from error
    hashes_by_pin: dict[tuple[str, str], list[str]] = {}
    hashes: list[str] = []
    for line in lines:
        pin, archive = _PIN.match(line), _HASH.search(line)
        if pin is not None:
            hashes = hashes_by_pin.setdefault((canonicalize_name(pin["name"]), pin["version"]), [])
        elif archive is not None:
            hashes.append(archive["sha256"])
    if not hashes_by_pin:
        raise UsageError(f"{lock} pins no package: name the requirements.lock that coec was installed from")
    return {key: tuple(sorted(values)) for key, values in hashes_by_pin.items()}


def _needs(package: Distribution, extras: frozenset[str]) -> Iterator[tuple[str, frozenset[str]]]:
    """The requirements of a package whose conditions hold on this machine, with their extras."""
    for line in package.requires or ():
        requirement = Requirement(line)
        marker = requirement.marker
        if marker is None or any(marker.evaluate({"extra": extra}) for extra in ("", *sorted(extras))):
            yield requirement.name, frozenset(requirement.extras)


def _licence(package: Distribution) -> str | None:
    """The licence that the package states, from its most precise statement."""
    metadata = package.metadata
    if "License-Expression" in metadata:
        return str(metadata["License-Expression"])
    stated = str(metadata.get_all("License", [""])[0]).strip()
    if stated in NAMED:
        return NAMED[stated]
    classifiers = [one for one in metadata.get_all("Classifier") or () if one.startswith("License ::")]
    if classifiers and all(one in CLASSIFIED for one in classifiers):
        return " OR ".join(sorted(CLASSIFIED[one] for one in classifiers))
    texts = (stated, *(_text(package, name) for name in metadata.get_all("License-File") or ()))
    return next((known for known in map(bsd_licence, texts) if known is not None), None)


def bsd_licence(text: str) -> str | None:
    """The licence of the BSD family that a text is, by its clauses; None if it is none."""
    normalised = " ".join(text.split())
    if "Redistribution and use in source and binary forms" not in normalised:
        return None
    return (
        "BSD-3-Clause"
        if re.search(r"[Nn]either the name|The name of the author may not be used", normalised)
        else "BSD-2-Clause"
    )


def _text(package: Distribution, name: str) -> str:
    return package.read_text(f"licenses/{name}") or package.read_text(name) or ""


def _native(package: Distribution) -> Iterator[NativeLibrary]:
    """The third-party libraries of a package: auditwheel and similar tools put them into `NAME.libs`, and their digests
    into the list of files."""
    for file in package.files or ():
        path = PurePosixPath(file)
        if (
            path.parent.suffix == ".libs"
            and ".so" in path.name
            and file.hash is not None
            and file.hash.mode == "sha256"
        ):
            digest = base64.urlsafe_b64decode(file.hash.value + "=" * (-len(file.hash.value) % 4))
            yield NativeLibrary(path.name, digest.hex())
