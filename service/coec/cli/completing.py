"""Values that the shell suggests for an option when Tab is pressed. This module is imported with every command line, so
heavy imports are made only on request."""

from __future__ import annotations


def depth_models(incomplete: str) -> list[str]:
    """Names of depth networks, and `stereo`."""
    from coec.adapters.depth.model_cards import built_in_cards

    return _beginning(("stereo", *built_in_cards()), incomplete)


def objectives(incomplete: str) -> list[str]:
    """Objectives."""
    return _beginning(("fused", "mi", "intensity"), incomplete)


def camera_models(incomplete: str) -> list[str]:
    """Camera models that can be fitted."""
    return _beginning(("double_sphere",), incomplete)


def export_formats(incomplete: str) -> list[str]:
    """Formats of `export`."""
    from coec.adapters.exports import FORMATS

    return _beginning(tuple(FORMATS), incomplete)


def query_keys(incomplete: str) -> list[str]:
    """Keys that can be queried; commands each by name."""
    from coec.cli.commands.query import KEYS
    from coec.schemas.commands import NAMES

    plain = [each.key for each in KEYS if "/" not in each.key]
    return _beginning((*plain, "windows/", "evidence/", *(f"command/{name}" for name in NAMES)), incomplete)


def _beginning(words: tuple[str, ...], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)]
