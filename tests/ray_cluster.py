"""A Ray cluster of nodes on this machine, each with one core, and what to do to them."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

STORE_CREDENTIALS = ("AWS_", "AZURE_", "GOOGLE_")
"""Prefixes of environment variables that the nodes do not get."""

RAY_MISSING = "needs the optional extra `ray`: pip install 'coec[ray]' in an environment for tests"


class RayNodes:
    """Two nodes. Only the first one runs the cluster's own services, so the second one may be lost."""

    def __init__(self, cluster: Any) -> None:
        self._cluster = cluster
        self.address: str = cluster.address
        self.second: Any = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)

    @property
    def logs(self) -> Path:
        """Folder with the logs of all nodes."""
        return Path(self._cluster.head_node.get_session_dir_path())

    def raylet_of_second(self) -> psutil.Process:
        """The process that is the second node."""
        return psutil.Process(self.second.all_processes["raylet"][0].process.pid)

    def judging_on_second(self) -> bool:
        """Whether a window is being judged on the second node."""
        for child in self.raylet_of_second().children(recursive=True):
            try:
                if child.cmdline()[:1] == ["ray::_Judge.row"]:
                    return True
            except psutil.Error:
                continue
        return False

    def kill_second(self) -> None:
        """Kills every process of the second node for good, as when its machine is taken away."""
        raylet = self.raylet_of_second()
        for process in [raylet, *raylet.children(recursive=True)]:
            process.kill()

    def freeze_second(self) -> list[psutil.Process]:
        """Stops every process of the second node, so that it falls silent with its connections open; returns them."""
        raylet = self.raylet_of_second()
        processes = [raylet, *raylet.children(recursive=True)]
        for process in processes:
            process.send_signal(signal.SIGSTOP)
        return processes


@contextmanager
def two_nodes() -> Iterator[RayNodes]:
    """Two nodes that have no credentials for stores. Skips if Ray is not installed."""
    pytest.importorskip("ray", reason=RAY_MISSING)
    from ray.cluster_utils import Cluster

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        for name in [name for name in os.environ if name.startswith(STORE_CREDENTIALS)]:
            patch.delenv(name)
        cluster = Cluster(
            initialize_head=True,
            head_node_args={"num_cpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False},
        )
        try:
            yield RayNodes(cluster)
        finally:
            cluster.shutdown()


def batch_command(*arguments: object) -> list[str]:
    """The command line of `coec batch`."""
    return [sys.executable, "-m", "coec", "batch", *map(str, arguments)]
