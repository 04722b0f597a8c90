"""How much evidence leaves a vehicle in a second."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import cast
from unittest.mock import Mock

import pytest

from coec.config import UplinkConfig
from coec.io.zenoh.bus import Request
from coec.schemas.keys import Keys
from coec.service.api.reply_builders import SerializedReply
from coec.service.api.routes import VehicleReplies, VehicleRoutes
from coec.service.api.uplink import BURST_BYTES, Uplink, UplinkBusyError

RATE = 100_000
PIECE = 2**20


@pytest.mark.fault("somebody fetches windows as fast as he can", "what goes out keeps to the configured rate")
def test_in_the_long_run_no_more_goes_out_than_is_configured(
    record_property: Callable[[str, object], None],
) -> None:
    now_s = 0.0
    uplink = Uplink(UplinkConfig(evidence_bytes_per_s=RATE), lambda: now_s)
    sent = 0
    for tick in range(3600 * 4):
        now_s = tick / 4
        with suppress(UplinkBusyError):
            uplink.admit("windows")
            uplink.count_sent("windows", PIECE)
            sent += PIECE
    rate = (sent - BURST_BYTES) / now_s
    record_property("figure", f"{rate / RATE:.3f} of the rate after the burst")
    assert rate <= RATE * (1 + PIECE / (RATE * 3600))
    assert rate >= 0.99 * RATE, "and no less, where somebody asks all the time"
    assert uplink.sent == {"windows": sent}
    assert uplink.refused["windows"] > 0


def test_nothing_is_admitted_while_more_went_out_than_the_rate_allows() -> None:
    uplink = Uplink(UplinkConfig(evidence_bytes_per_s=RATE), lambda: 0.0)
    uplink.count_sent("windows", BURST_BYTES + RATE)
    with pytest.raises(UplinkBusyError, match=r"ask again in 1\.0 s"):
        uplink.admit("overlay")
    assert uplink.refused == {"overlay": 1}


@pytest.mark.parametrize("resource", ["history", "overlay", "windows/front-1", "evidence/front-1"])
def test_nothing_is_read_that_may_not_go_out(resource: str) -> None:
    uplink = Uplink(UplinkConfig(evidence_bytes_per_s=RATE), lambda: 0.0)
    uplink.count_sent("windows", BURST_BYTES + RATE)
    keys, bus, pair, unasked = Keys("coec", "test"), Mock(), Mock(), SerializedReply(b"", b"")
    pair.name = "front"
    VehicleRoutes(
        keys, {"front": pair}, Mock(), VehicleReplies(unasked, unasked), lambda: b"", Mock(), Mock(), uplink
    ).declare(bus)
    finders = {call.args[0]: call.args[1] for call in bus.serve.call_args_list}
    (route,) = finders[f"{keys.root}/front/**"](f"{keys.root}/front/{resource}")
    with pytest.raises(UplinkBusyError, match=r"ask again in 1\.0 s"):
        route.answer(cast("Request", Mock(parameters="", received_s=0.0)))
    assert pair.mock_calls == []


def test_a_new_rate_holds_at_once_and_gives_nothing_for_the_time_before() -> None:
    now_s = 0.0
    uplink = Uplink(UplinkConfig(evidence_bytes_per_s=RATE), lambda: now_s)
    uplink.count_sent("windows", BURST_BYTES + 10 * RATE)
    now_s = 5.0
    uplink.reconfigure(UplinkConfig(evidence_bytes_per_s=5 * RATE))
    with pytest.raises(UplinkBusyError, match=r"1\.0 s"):
        uplink.admit("windows")
