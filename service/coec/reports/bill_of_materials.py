"""A software bill of materials: CycloneDX for programs, a table of licences for people.

Source of the form: CycloneDX 1.6, JSON (ECMA-424).
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from typing import Any

from coec.io.installed_packages import NativeLibrary, Package

SPEC_VERSION = "1.6"
NOT_STATED = "not stated"

Hashes = Mapping[tuple[str, str], Sequence[str]]
"""sha256 of the archives of a package, by canonical name and version."""


@dataclass(frozen=True, slots=True)
class Network:
    """A depth network that is part of the package, with the `sha256` of its file, hexadecimal."""

    name: str
    sha256: str
    licence: str


@dataclass(frozen=True, slots=True)
class Inventory:
    """What an installation is made of: the application, the packages that it needs by canonical name, the interpreter's
    version, and the networks that it brings."""

    application: Package
    packages: Mapping[str, Package]
    python: str
    networks: Sequence[Network]


def cyclonedx(inventory: Inventory, hashes: Hashes, made: datetime | None) -> dict[str, Any]:
    """The CycloneDX document; the same installation always gives the same one.

    Args:
        hashes: of the archives from which the packages may have been installed; none where they are not known.
        made: time stamp of the document, with a time zone; None: it has none.
    """
    application = inventory.application
    own = _reference(application)
    interpreter = f"pkg:generic/python@{inventory.python}"
    components: list[dict[str, Any]] = [_component(key, package, hashes) for key, package in inventory.packages.items()]
    components.append(
        {
            "type": "platform",
            "bom-ref": interpreter,
            "name": "CPython",
            "version": inventory.python,
            "purl": interpreter,
            "licenses": [{"expression": "PSF-2.0"}],
        }
    )
    components += [
        {
            "type": "machine-learning-model",
            "bom-ref": f"{own}#{network.name}",
            "name": network.name,
            "version": application.version,
            "hashes": [_sha256(network.sha256)],
            "licenses": [_licence(network.licence)],
        }
        for network in inventory.networks
    ]
    models = [f"{own}#{network.name}" for network in inventory.networks]
    needed = {key: _reference(package) for key, package in inventory.packages.items()}
    dependencies = [
        {"ref": own, "dependsOn": [*(needed[key] for key in application.requires), interpreter, *models]},
        *(
            {"ref": needed[key], "dependsOn": [needed[name] for name in package.requires]}
            for key, package in inventory.packages.items()
        ),
    ]
    return {
        "bomFormat": "CycloneDX",
        "specVersion": SPEC_VERSION,
        "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, repr((components, dependencies)))}",
        "version": 1,
        "metadata": {
            **({} if made is None else {"timestamp": made.isoformat(timespec="seconds")}),
            "tools": {
                "components": [{"type": "application", "name": application.name, "version": application.version}]
            },
            "component": {
                "type": "application",
                "bom-ref": own,
                "name": application.name,
                "version": application.version,
                "purl": own,
                "licenses": [_licence(application.licence)],
            },
        },
        "components": components,
        "dependencies": dependencies,
    }


def licence_table(inventory: Inventory) -> str:
    """The licences as Markdown: each package with its licence, and libraries of others that packages contain."""
    rows = [
        f"| {package.name} | {package.version} | {package.licence or NOT_STATED} |\n"
        for package in inventory.packages.values()
    ]
    packers = [
        f"| {package.name} | {', '.join(names_of(package.native))} | {', '.join(_texts(package)) or NOT_STATED} |\n"
        for package in inventory.packages.values()
        if package.native
    ]
    networks = [f"| {network.name} | {network.licence} |\n" for network in inventory.networks]
    return (
        "# Licences\n\n"
        f"{inventory.application.name} itself is under {inventory.application.licence}. Written by `coec sbom --output "
        "DIR` from what the installed packages\nsay of themselves; `coec.cdx.json` beside it is the same for programs "
        "(CycloneDX).\n\n"
        "| package | version | licence |\n|---|---|---|\n"
        f"{''.join(rows)}\n"
        "The interpreter, CPython, is under PSF-2.0; Debian's packages in the image bring their texts in\n"
        "`/usr/share/doc/*/copyright`.\n\n"
        "Some packages have libraries of others packed in, under licences of their own, that the package's texts name\n"
        "(`NAME-VERSION.dist-info/licenses`). What is linked into a package's own modules only its texts tell.\n\n"
        "| package | libraries | texts |\n|---|---|---|\n"
        f"{''.join(packers)}\n"
        "| depth network in the package | licence |\n|---|---|\n"
        f"{''.join(networks)}"
    )


def names_of(libraries: Sequence[NativeLibrary]) -> list[str]:
    """Each name once."""
    return [name for name, _ in groupby(sorted(library.name for library in libraries))]


def _texts(package: Package) -> list[str]:
    """Licence files of the whole package, without those of a folder of its source."""
    return [name for name in package.licence_files if "/" not in name]


def _component(key: str, package: Package, hashes: Hashes) -> dict[str, Any]:
    reference = _reference(package)
    component: dict[str, Any] = {
        "type": "library",
        "bom-ref": reference,
        "name": package.name,
        "version": package.version,
        "purl": reference,
        "licenses": [_licence(package.licence)],
    }
    archives = hashes.get((key, package.version), ())
    if archives:
        # The archives for all platforms, because no installer records which of them it unpacked.
        links = {"type": "distribution", "url": reference, "hashes": [_sha256(archive) for archive in archives]}
        component["externalReferences"] = [links]
    if package.native:
        component["components"] = [
            {
                "type": "library",
                "bom-ref": f"{reference}#{library.file}",
                "name": library.file,
                "hashes": [_sha256(library.sha256)],
            }
            for library in package.native
        ]
    return component


def _reference(package: Package) -> str:
    """Package URL: the name in lower case with `-` (purl-spec, type pypi)."""
    return f"pkg:pypi/{package.name.lower().replace('_', '-')}@{package.version}"


def _licence(expression: str | None) -> dict[str, Any]:
    return {"license": {"name": NOT_STATED}} if expression is None else {"expression": expression}


def _sha256(content: str) -> dict[str, str]:
    return {"alg": "SHA-256", "content": content}
