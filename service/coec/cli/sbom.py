"""`coec sbom`: the bill of materials of this installation, with licences."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coec.cli.options import Json
from coec.errors import UsageError

if TYPE_CHECKING:
    from coec.reports.bill_of_materials import Inventory, Network

APPLICATION = "coec"

DOCUMENT, TABLE = "coec.cdx.json", "licences.md"

SOURCE_DATE_EPOCH = "SOURCE_DATE_EPOCH"
"""Variable with the time of a reproducible build (reproducible-builds.org)."""


def sbom(
    lock: Annotated[
        Path | None,
        typer.Option(help="requirements.lock of the installation, for hashes.", metavar="FILE"),
    ] = None,
    output: Annotated[Path | None, typer.Option(help="Write coec.cdx.json and licences.md.", metavar="DIR")] = None,
    as_json: Json = False,
) -> int:
    """List the packages of this installation: a table of licences, with --json a bill of materials (CycloneDX)."""
    from coec.io.installed_packages import pinned_hashes
    from coec.io.user_files import write_output
    from coec.reports import bill_of_materials, console

    hashes = {} if lock is None else pinned_hashes(lock)
    inventory = inventory_here()
    document = bill_of_materials.cyclonedx(inventory, hashes, _build_time())
    if output is not None:
        text = json.dumps(document, indent=2, ensure_ascii=False) + "\n"
        written = [
            write_output(output / DOCUMENT, text.encode()),
            write_output(output / TABLE, bill_of_materials.licence_table(inventory).encode()),
        ]
        console.say(f"coec: wrote {', '.join(str(path) for path in written)}")
    if as_json:
        console.print_json(document)
        return 0
    listed = console.table("package", "version", "licence", "libraries of others packed in")
    for package in (inventory.application, *inventory.packages.values()):
        native = ", ".join(bill_of_materials.names_of(package.native))
        listed.add_row(package.name, package.version, package.licence or bill_of_materials.NOT_STATED, native)
    console.out.print(listed)
    return 0


def _build_time() -> datetime | None:
    """The time that SOURCE_DATE_EPOCH names (seconds since 1970); None where it is not set, because a document with the
    present time would differ from one made a second later of the same installation."""
    text = os.environ.get(SOURCE_DATE_EPOCH)
    if not text:
        return None
    try:
        return datetime.fromtimestamp(int(text), UTC)
    except (ValueError, OverflowError, OSError) as error:
        raise UsageError(f"{SOURCE_DATE_EPOCH}={text}: the seconds since 1970 are expected") from error


def inventory_here() -> Inventory:
    """Inventory of the installation that runs this.

    Raises:
        NotFoundError: coec is not installed as a package, or something it needs is not.
    """
    from coec.io.installed_packages import installed_packages
    from coec.reports.bill_of_materials import Inventory

    packages = installed_packages(APPLICATION)
    application = packages.pop(APPLICATION)
    return Inventory(application, packages, platform.python_version(), _networks())


def _networks() -> Sequence[Network]:
    """The networks whose file comes with the package."""
    from coec.io.depth.model_cards import CARDS, list_models
    from coec.io.depth.onnx_network import file_identity
    from coec.reports.bill_of_materials import Network

    networks = []
    for card in list_models():
        file = CARDS / f"{card.name}.onnx"
        if file.is_file():
            digest, _ = file_identity(file)
            networks.append(Network(card.name, digest, card.licence))
    return networks
