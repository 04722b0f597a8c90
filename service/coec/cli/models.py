"""`coec models`: lists the known depth networks, and copies their files to where services load them."""

from pathlib import Path
from typing import Annotated

import typer

from coec.cli.options import Force, Json
from coec.errors import ModelError
from coec.reports import console

app = typer.Typer(
    help="Depth networks: list the known ones and whose file is present, add a file, show its card, assess it."
)


@app.callback(invoke_without_command=True)
def models(context: typer.Context, as_json: Json = False) -> int:
    return _list(as_json=as_json) if context.invoked_subcommand is None else 0


@app.command()
def show(
    file: Annotated[Path, typer.Argument(help="An ONNX file.", metavar="FILE", show_default=False)],
    as_json: Json = False,
) -> int:
    """Show the model card with which a network file is run."""
    from coec.io.depth.model_cards import find_card
    from coec.io.depth.onnx_network import file_identity

    if not file.is_file():
        raise ModelError(f"there is no file {file}")
    digest, identity = file_identity(file)
    card = find_card(file, digest)
    document = {"file": str(file), "sha256": digest, "identity": identity, "card": card.model_dump(mode="json")}
    console.report(document, lambda: console.show_json(document), as_json=as_json)
    return 0


@app.command()
def add(
    file: Annotated[Path, typer.Argument(help="The ONNX file of a known network.", metavar="FILE", show_default=False)],
    name: Annotated[
        str | None,
        typer.Option(
            "--as", help="Network that the file is an export of, if its sha256 and name do not say so.", metavar="NAME"
        ),
    ] = None,
    force: Force = False,
    as_json: Json = False,
) -> int:
    """Copy the file of a known depth network to where this user's services load it, after checking it."""
    from coec.io.depth import depth_maps

    card, place, copied = depth_maps.add_network(file, name, force=force)
    if as_json:
        console.print_json({"name": card.name, "path": str(place), "copied": copied})
    elif copied:
        console.show(f"{card.name}: checked, copied to {place}; `--depth {card.name}` uses it. Licence: {card.licence}")
    else:
        console.show(f"{card.name}: the same file exists already, {place}")
    return 0


def _list(*, as_json: bool) -> int:
    """Lists the built-in cards: whose file is present, and where the others come from."""
    from coec.io.depth import depth_maps
    from coec.io.depth.depth_maps import models_folder
    from coec.io.depth.model_cards import list_models

    cards = list_models()
    folder = models_folder()
    files = {card.name: depth_maps.network_file(card) for card in cards}
    if as_json:
        documents = [
            {
                **card.model_dump(mode="json"),
                "present": files[card.name] is not None,
                "path": None if files[card.name] is None else str(files[card.name]),
                "looked_for": [str(path) for path in depth_maps.candidate_paths(card)],
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
        f"an absent network is expected as NAME.onnx in {folder}; `coec models add FILE` checks it and copies it there"
    )
    console.show("any other ONNX file is used by its path (docs/own-network.md)")
    return 0
