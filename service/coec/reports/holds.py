"""Who holds an extrinsic, in words: for `health` of the service, and for clients that ask."""

from __future__ import annotations

from coec.reports.instants import second


def hold_text(sender: str, since_ns: int | None, reason: str | None) -> str:
    """By whom, since when and why, as far as that is known; the beginning of a sentence."""
    who = f" by {sender}" if sender else " by command"
    since = "" if since_ns is None else f" since {second(since_ns)}"
    return f"held{who}{since}: {reason or 'no reason was given'}"
