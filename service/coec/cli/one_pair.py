"""Chooses the pair that a command is about."""

from __future__ import annotations

from coec.config import Config, PairConfig
from coec.errors import UsageError


def pair_named(config: Config, name: str | None) -> PairConfig:
    """The pair of this name, or with None the only one.

    Raises:
        UsageError: no pair has this name, there are several to choose from, or the pair is still awaited.
    """
    pairs = {pair.name: pair for pair in config.pairs}
    if name is None and len(pairs) == 1:
        return config.pairs[0]
    if name in {pair.name for pair in config.awaited} or (name is None and not pairs):
        raise UsageError("the pair is awaited: the service has not found what its configuration leaves out")
    if name is None or name not in pairs:
        raise UsageError(f"--pair: the configuration has the pairs {', '.join(pairs)}; choose one")
    return pairs[name]
