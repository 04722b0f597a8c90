"""`coec models`: lists the known depth networks, and puts their files where they are looked for."""

from __future__ import annotations

from pathlib import Path

from coec.adapters.depth import network_files
from coec.adapters.depth.model_cards import find_card, list_models
from coec.adapters.depth.network_files import models_folder
from coec.adapters.depth.onnx_network import file_identity
from coec.errors import ModelError
from coec.reports import console


def show(file: Path, *, as_json: bool) -> int:
    """Prints the card of a file.

    Raises:
        ModelError: the file is absent or has no card.
    """
    if not file.is_file():
        raise ModelError(f"there is no file {file}")
    digest, identity = file_identity(file)
    card = find_card(file, digest)
    document = {"file": str(file), "sha256": digest, "identity": identity, "card": card.model_dump(mode="json")}
    if as_json:
        console.print_json(document)
    else:
        console.show_json(document)
    return 0


def add(file: Path, name: str | None, *, force: bool, as_json: bool) -> int:
    """Copies the file of a known network to where it is looked for, and says so.

    Raises:
        ModelError, UsageError, OutputError: see `network_files.add`.
    """
    card, place, copied = network_files.add(file, name, force=force)
    if as_json:
        console.print_json({"name": card.name, "path": str(place), "copied": copied})
    elif copied:
        console.show(f"{card.name}: checked, copied to {place}; `--depth {card.name}` uses it. Licence: {card.licence}")
    else:
        console.show(f"{card.name}: the same file is there already, {place}")
    return 0


def run(*, as_json: bool) -> int:
    """Lists the built-in cards: whose file is present, and where the others come from."""
    cards = list_models()
    folder = models_folder()
    files = {card.name: network_files.file_of(card) for card in cards}
    if as_json:
        documents = [
            {
                **card.model_dump(mode="json"),
                "present": files[card.name] is not None,
                "path": None if files[card.name] is None else str(files[card.name]),
                "looked_for": [str(path) for path in network_files.places_of(card)],
            }
            for card in cards
        ]
        console.print_json({"folder": str(folder), "models": documents})
        return 0
    listed = console.table("name", "file", "sha256", "licence", "comes from")
    for card in cards:
        digest = card.sha256[:12] if card.sha256 else "any export"
        state = "absent" if files[card.name] is None else "present"
        listed.add_row(card.name, state, digest, card.licence, card.obtain)
    console.out.print(listed)
    console.show("")
    for name, path in files.items():
        if path is not None:
            console.show(f"{name}: {path}")
    console.show(
        f"an absent network is looked for as NAME.onnx in {folder}; `coec models add FILE` checks it and puts it there"
    )
    console.show("any other ONNX file is used by its path (docs/own-network.md)")
    return 0
