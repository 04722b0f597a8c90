"""A router's door under a flood from one address, and an operator at another: run as a program in a network namespace
of its own, with `deploy/nftables.conf` in front. Prints what came of it as JSON.

    unshare --net python tests/flooding.py RULES ROUTER_FILE ATTACKER_FILE OPERATOR_FILE KIND SECONDS

RULES "none": nothing in front. KIND `silent`: connections that never speak, 20 a second; `sessions`: sessions with the
certificate of the file, as many as can be had.
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import zenoh

ATTACKER_ADDRESS, OPERATOR_ADDRESS = "127.0.0.2", "127.0.0.3"
PORT = 7448
PER_S = 20.0
WAIT_S = 3.0


def session(file: str, source: str) -> zenoh.Session:
    settings = zenoh.Config.from_file(file)
    settings.insert_json5("connect/endpoints", json.dumps([f"tls/localhost:{PORT}#bind={source}:0"]))
    settings.insert_json5("connect/timeout_ms", str(round(WAIT_S * 1e3)))
    settings.insert_json5("connect/exit_on_failure", "true")
    return zenoh.open(settings)


class Flood:
    """One attack, in threads."""

    def __init__(self, kind: str, file: str) -> None:
        self.held: list[object] = []
        self._file = file
        self._stop = threading.Event()
        for _ in range(8):
            threading.Thread(target=self._connect if kind == "silent" else self._open, daemon=True).start()

    def _connect(self) -> None:
        while not self._stop.wait(8 / PER_S):
            try:
                self.held.append(socket.create_connection(("127.0.0.1", PORT), 1.0, (ATTACKER_ADDRESS, 0)))
            except OSError:
                continue

    def _open(self) -> None:
        while not self._stop.is_set():
            try:
                self.held.append(session(self._file, ATTACKER_ADDRESS))
            except zenoh.ZError:
                continue

    def stop(self) -> None:
        self._stop.set()


def main(rules: str, router: str, attacker: str, operator: str, kind: str, seconds: str) -> None:
    subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
    if rules != "none":
        # All of this happens on loopback, which the rules as they are shipped let through.
        text = Path(rules).read_text().replace('iifname "lo" accept', "")
        subprocess.run(["nft", "-f", "-"], input=text, text=True, check=True)
    opened: list[float | None] = []
    with zenoh.open(zenoh.Config.from_file(router)):
        flood = Flood(kind, attacker)
        end_s = time.monotonic() + float(seconds)
        while time.monotonic() < end_s:
            began_s = time.monotonic()
            try:
                session(operator, OPERATOR_ADDRESS).close()
                opened.append(time.monotonic() - began_s)
            except zenoh.ZError:
                opened.append(None)
            time.sleep(1.0)
        flood.stop()
        sys.stdout.write(json.dumps({"attacker_holds": len(flood.held), "operator_waited_s": opened}) + "\n")
        sys.stdout.flush()
        os._exit(0)  # 64 sessions that hang close for minutes


if __name__ == "__main__":
    main(*sys.argv[1:])
