"""What a shell is told of values that an option knows, when a person presses Tab. Imported with every command line:
what is heavy is imported when it is asked for."""

from __future__ import annotations


def depth_models(incomplete: str) -> list[str]:
    """Names of networks, and `stereo`."""
    from coec.adapters.depth.model_cards import built_in_cards

    return _beginning(("stereo", *built_in_cards()), incomplete)


def objectives(incomplete: str) -> list[str]:
    """Of `calibrate`, and `all` of `evaluate`."""
    return _beginning(("fused", "mi", "intensity"), incomplete)


def camera_models(incomplete: str) -> list[str]:
    """That can be fitted."""
    return _beginning(("double_sphere",), incomplete)


def export_formats(incomplete: str) -> list[str]:
    """Of `export`."""
    from coec.adapters.exports import FORMATS

    return _beginning(tuple(FORMATS), incomplete)


def query_keys(incomplete: str) -> list[str]:
    """What can be asked for; of commands, each by its name."""
    from coec.cli.commands.query import KEYS
    from coec.schemas.commands import NAMES

    plain = [each.key for each in KEYS if "/" not in each.key]
    return _beginning((*plain, "windows/", "evidence/", *(f"command/{name}" for name in NAMES)), incomplete)


def _beginning(words: tuple[str, ...], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]
