"""The list of a pair's recordings. It is serialised only when it has changed, because thousands make a megabyte."""

from __future__ import annotations

from dataclasses import dataclass, field

from coec.adapters.zenoh.bus import Answer
from coec.runtime.api.snapshots import answer_of
from coec.runtime.recording.snippet_store import SnippetStore
from coec.runtime.recording.window_store import WindowStore
from coec.schemas.keys import Format
from coec.schemas.replies import SnippetInfo, WindowInfo, WindowsReply


@dataclass(frozen=True, slots=True)
class _CachedListing:
    """A listing, and the answers that were made of it."""

    windows: tuple[WindowInfo, ...]
    snippets: tuple[SnippetInfo, ...]
    answers: dict[Format, Answer] = field(default_factory=dict)


class WindowsList:
    """The list of one pair. For any thread."""

    def __init__(self, vehicle: str, pair: str, windows: WindowStore, snippets: SnippetStore | None) -> None:
        self._vehicle, self._pair = vehicle, pair
        self._windows, self._snippets = windows, snippets
        self._listing = _CachedListing((), ())

    def answer(self, form: Format) -> Answer:
        """The present list in the encoding that is asked for."""
        windows = self._windows.listing(self._pair)
        snippets = () if self._snippets is None else self._snippets.listing(self._pair)
        listing = self._listing
        # The store hands out the same tuple until it changes. Identity is compared, because comparing thousands of
        # entries takes as long as packing them.
        if listing.windows is not windows or listing.snippets != snippets:
            listing = self._listing = _CachedListing(windows, snippets)
        answer = listing.answers.get(form)
        if answer is None:
            reply = WindowsReply(vehicle=self._vehicle, pair=self._pair, windows=windows, snippets=snippets)
            answer = listing.answers[form] = answer_of(reply, form)
        return answer
