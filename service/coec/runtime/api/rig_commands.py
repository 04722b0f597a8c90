"""Commands for a sensor or for the whole rig: each is given to all pairs concerned. For any thread.

A sensor has no extrinsic of its own: what a command holds, puts back or accepts is what the sensor's pairs serve. So a
command for a sensor is given to each of its pairs in turn, and the thread that decides about the pair carries it out.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from coec.errors import CoecError, NotFoundError
from coec.runtime.api.awaited import PendingPairCommands
from coec.runtime.api.commands import EXPIRED, Commands
from coec.schemas.keys import RIG
from coec.schemas.replies import Acknowledgement
from coec.schemas.rig_state import RigReply

PairCommands = Commands | PendingPairCommands


class RigCommands:
    """The rig commands of one vehicle. `pairs` may gain pairs while commands come."""

    def __init__(self, vehicle: str, pairs: Mapping[str, PairCommands], rig: Callable[[], RigReply]) -> None:
        """`rig()` gives the reply that names the pairs of each sensor."""
        self._vehicle = vehicle
        self._pairs = pairs
        self._rig = rig

    def reserve_for(self, proven: Iterable[str]) -> None:
        """Does nothing: every pair reserves for itself."""

    def carry_out(
        self, name: str, arguments: dict[str, Any], sender: str, deadline_s: float = math.inf
    ) -> Acknowledgement:
        """Gives a command to every pair of `arguments["sensor"]`, or of the vehicle if no sensor is named.

        Raises:
            NotFoundError: there is no such sensor.
        """
        pair_arguments = dict(arguments)
        pairs = self._pairs_of(pair_arguments.pop("sensor", None))
        done = []
        for pair in pairs:
            if time.monotonic() > deadline_s:
                done.append(Acknowledgement(
                    vehicle=self._vehicle, pair=pair, command=name, accepted=False, code="expired", text=EXPIRED
                ))  # fmt: skip
            else:
                done.append(self._pairs[pair].carry_out(name, dict(pair_arguments), sender, deadline_s))
        refused = [one for one in done if not one.accepted]
        code = refused[0].code if refused else done[0].code
        durable = [one.durable for one in done if one.durable is not None]
        return Acknowledgement(
            vehicle=self._vehicle,
            pair=RIG,
            command=name,
            accepted=not refused,
            code=code if len(refused) in (0, len(done)) else "in_part",
            text=" ".join(f"{one.pair}: {one.text}" for one in done),
            durable=all(durable) if durable else None,
        )

    def note_refused(self, name: str, sender: str, why: CoecError) -> None:
        """Counts the refusal for every pair, because the command was meant for all of them."""
        for commands in self._pairs.values():
            commands.note_refused(name, sender, why)

    def _pairs_of(self, sensor: str | None) -> tuple[str, ...]:
        if sensor is None:
            return tuple(self._pairs)
        sensors = {one.name: one.pairs for one in self._rig().sensors}
        if sensor not in sensors:
            raise NotFoundError(f"no such sensor; the rig has {', '.join(sensors)}")
        return tuple(pair for pair in sensors[sensor] if pair in self._pairs)
