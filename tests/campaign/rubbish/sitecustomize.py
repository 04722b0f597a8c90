"""Makes a worker process answer rubbish while a file exists. Python imports this by itself where its folder is on
PYTHONPATH: the service is as it is, only its worker's end of the wire lies.

`CAMPAIGN_RUBBISH` names the file; processes that are no worker are left alone.
"""

from __future__ import annotations

import os
import random
import sys
from pathlib import Path

WORKER = "coec.service.worker.worker_main"

LIES = (
    b"\xc1 no msgpack at all",
    b"\x93\x01\x02\x03",  # a list
    b"\x80",  # a map without anything in it
    b"\x81\xa4kind\xa4done",  # an answer to something else
    b"\x81\xa4kind\xa8observed",  # an answer without its content
    b"\x82\xa4kind\xa6solved\xa6result\xc4\x02\xff\xff",
    b"\x81\xa4kind\xa6dreams",
)


def _corrupt(flag: Path) -> None:
    from multiprocessing.connection import Connection

    honest = Connection.send_bytes
    draws = random.Random(os.getpid())

    def send_bytes(self: Connection, buf: bytes, *more: int) -> None:
        # An empty part ends a message; it stays where it is, so that what is said is a message.
        lie = buf and flag.exists()
        honest(self, draws.choice(LIES) if lie else buf, *more)

    Connection.send_bytes = send_bytes  # type: ignore[method-assign,assignment]  # which is the purpose


if WORKER in sys.orig_argv and "CAMPAIGN_RUBBISH" in os.environ:
    _corrupt(Path(os.environ["CAMPAIGN_RUBBISH"]))
