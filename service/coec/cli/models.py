"""`coec models`: lists the known depth networks."""

from __future__ import annotations

from pathlib import Path

from coec.adapters.depth.maps import models_folder
from coec.adapters.depth.model_cards import find_card, list_models
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


def run(*, as_json: bool) -> int:
    """Lists the built-in cards."""
    cards = list_models()
    if as_json:
        folder = str(models_folder())
        console.print_json({"folder": folder, "models": [card.model_dump(mode="json") for card in cards]})
        return 0
    listed = console.table("name", "file", "output", "sha256", "licence")
    for card in cards:
        digest = card.sha256[:12] if card.sha256 else "any"
        listed.add_row(card.name, card.file or f"{card.name}.onnx", card.output.kind, digest, card.licence)
    console.out.print(listed)
    console.show("")
    console.show(f"networks are looked for by name in {models_folder()}; any other ONNX file by its path")
    return 0
