"""The pair that a command is about."""

from __future__ import annotations

from coec.config import Config, PairConfig
from coec.errors import UsageError


def pair_named(config: Config, name: str | None) -> PairConfig:
    """The one of this name, or (None) the only one.

    Raises:
        UsageError: there is none of this name, or there are several to choose from.
    """
    pairs = {pair.name: pair for pair in config.pairs}
    if name is None and len(pairs) == 1:
        return config.pairs[0]
    if name is None or name not in pairs:
        raise UsageError(f"--pair: the configuration has the pairs {', '.join(pairs)}; choose one")
    return pairs[name]
