"""The relay that stands for a bridge: what a node publishes comes to the key of its topic, and back."""

from __future__ import annotations

import zenoh

from coec.io.ros import messages
from e2e.processes import routing
from peers.nodes import Inbox, Topic, node, relay
from support.ros import compressed_image, twist

IMAGE, SPEED = "/front/image/compressed", "/speed"
WITHIN_S = 60.0


def test_messages_go_both_directions() -> None:
    image, speed = compressed_image(), twist()
    inbox, keys = Inbox(), Inbox()
    with routing() as router:

        def received(sample: zenoh.Sample) -> None:
            keys.receive(str(sample.key_expr), sample.payload.to_bytes())

        subscriber = router.session.declare_subscriber("front/image/compressed", received)
        camera, motion = {IMAGE: Topic(messages.COMPRESSED_IMAGE)}, {SPEED: Topic(messages.TWIST, latched=True)}
        with relay(router.session, camera, motion), node("vehicle", camera, motion, inbox.receive) as vehicle:
            vehicle.wait_for_peers(IMAGE, SPEED)
            vehicle.publish(IMAGE, image)
            (arrived,) = keys.until("front/image/compressed", lambda result: len(result) == 1, "an image", WITHIN_S)
            router.session.put("speed", speed)
            (back,) = inbox.until(SPEED, lambda result: len(result) == 1, "a speed", WITHIN_S)
        subscriber.undeclare()
    assert arrived[:4] == b"\0\1\0\0"
    assert image[-40:] in arrived
    assert len(back) - len(speed) in range(-3, 4)
