"""The engine of a Ray cluster, on a stand-in for Ray whose actors and nodes misbehave."""

from __future__ import annotations

import pickle
import socket
import sys
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from coec import __version__
from coec.errors import SourceError
from coec.fleet import engines as engine_module
from coec.fleet.engines import NODE_DIED, SILENCE_S, RayEngine
from coec.fleet.evaluator import ReplaySettings
from coec.fleet.jobs import Job, StoreCredentials, empty_row, failed_row
from coec.fleet.worker_pool import NODE_LOST, NOT_ON_NODE, FleetError, WorkerLimits

BOUNDS = WorkerLimits(600.0, 2**30)
GIB = 2.0**30


class RayError(Exception):
    """As in `ray.exceptions`."""


class ActorDiedError(RayError):
    """An actor that has ended."""


class ActorUnavailableError(RayError):
    """An actor that cannot be reached."""


class GetTimeoutError(RayError):
    """An answer that did not come in time."""


class Reference:
    """An answer that comes later, or never."""


@dataclass(eq=False)
class Node:
    """A node of the cluster.

    Attributes:
        version: of coec on it; None: it is not installed.
        fate: what becomes of it at its first window: it lives, dies, breaks its connections, or falls silent.
        shares: whether it has the files of this machine.
    """

    fate: str = "lives"
    version: str | None = __version__
    shares: bool = True
    free: bool = True
    silent: bool = False


@dataclass(eq=False)
class FakeActor:
    """The handle of an actor; its methods are sent to where it runs."""

    ray: FakeRay
    node: Node | None
    calls: deque[tuple[str, Reference, tuple[Any, ...]]] = field(default_factory=deque)
    error: RayError | None = None

    def __getattr__(self, name: str) -> Any:
        def remote(*arguments: Any) -> Reference:
            reference = Reference()
            self.calls.append((name, reference, arguments))
            return reference

        return SimpleNamespace(remote=remote)


class FakeRay(ModuleType):
    """What the engine uses of Ray. Time passes when it waits."""

    def __init__(self, nodes: Sequence[Node]) -> None:
        super().__init__("ray")
        self.all = list(nodes)
        self.actors: list[FakeActor] = []
        self.answers: dict[Reference, Any] = {}
        self.now_s = 0.0
        self.addresses: list[str] = []
        self.arguments: list[tuple[Any, ...]] = []
        self.options: list[dict[str, Any]] = []
        self.exceptions = SimpleNamespace(
            RayError=RayError, ActorUnavailableError=ActorUnavailableError, GetTimeoutError=GetTimeoutError
        )

    def init(self, address: str, **_: Any) -> None:
        self.addresses.append(address)
        if not self.all:
            raise ConnectionError("Could not find any running Ray instance.")

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": {"CPU": 1.0, "memory": 2 * GIB}} for _ in self.all]

    def remote(self, _: type) -> Any:
        def options(**given: Any) -> Any:
            self.options.append(given)
            return SimpleNamespace(remote=create)

        def create(*arguments: Any) -> FakeActor:
            self.arguments.append(arguments)
            node = next((node for node in self.all if node.free), None)
            if node is not None:
                node.free = False
            self.actors.append(FakeActor(self, node))
            return self.actors[-1]

        return SimpleNamespace(options=options)

    def wait(self, references: Sequence[Reference], num_returns: int, timeout: float) -> tuple[list[Reference], Any]:
        assert references
        for actor in self.actors:
            if actor.node is not None and not actor.node.silent:
                self._run(actor, actor.node)
        done = [one for one in references if one in self.answers]
        if not done:
            self.now_s += timeout
        return done[:num_returns], None

    def _run(self, actor: FakeActor, node: Node) -> None:
        while actor.calls:
            name, reference, arguments = actor.calls[0]
            if name == "row" and node.fate != "lives":
                if node.fate == "silent":
                    node.silent = True
                    return
                text = f"The actor died {NODE_DIED}." if node.fate == "dies" else "unavailable"
                actor.error = ActorDiedError(text) if node.fate == "dies" else ActorUnavailableError(text)
            actor.calls.popleft()
            self.answers[reference] = actor.error or self._answer(node, name, arguments)

    def _answer(self, node: Node, name: str, arguments: tuple[Any, ...]) -> Any:
        if name == "versions":
            if node.version is None:
                return ActorDiedError(
                    "in its creation task\n  File x\n\x1b[31mModuleNotFoundError: No module coec\x1b[0m"
                )
            return "some-node", node.version
        if name == "ping":
            return None
        (job,) = arguments
        row = empty_row(job, {}).model_copy(update={"sha256": "0" * 64})
        if not node.shares:
            row = failed_row(empty_row(job, {}), SourceError.reply_code, "cannot read it")
        return row.model_dump_json()

    def get(self, reference: Reference, timeout: float) -> Any:
        assert timeout > 0.0
        answer = self.answers[reference]
        if isinstance(answer, RayError):
            raise answer
        return answer

    def kill(self, actor: FakeActor) -> None:
        if actor.node is not None and actor.node.fate == "lives":
            actor.node.free = True
        actor.node = None

    def shutdown(self) -> None:
        pass


Cluster = Callable[..., FakeRay]


@pytest.fixture
def cluster(monkeypatch: pytest.MonkeyPatch) -> Cluster:
    """Puts a cluster of these nodes in the place of Ray."""
    monkeypatch.setattr(engine_module, "CURRENT", Path("/nonexistent"))
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")

    def make(*nodes: Node) -> FakeRay:
        fake = FakeRay(nodes)
        monkeypatch.setitem(sys.modules, "ray", fake)

        def clock() -> float:
            return fake.now_s

        monkeypatch.setattr(engine_module, "time", SimpleNamespace(monotonic=clock, sleep=lambda _: None))
        return fake

    return make


def judged(count: int = 6, jobs: Sequence[Job] | None = None, bounds: WorkerLimits = BOUNDS) -> dict[str, str | None]:
    rows = list(
        RayEngine(None, bounds).rows(jobs or [Job(f"{index}.mcap") for index in range(count)], ReplaySettings())
    )
    assert len({row.url for row in rows}) == len(rows)
    return {row.url: row.error_code for row in rows}


@pytest.mark.fault("a Ray node dies, cannot be reached, or falls silent", "its windows are judged elsewhere, once each")
@pytest.mark.parametrize("fate", ["dies", "breaks", "silent"])
def test_windows_of_a_lost_node_are_judged_elsewhere(cluster: Cluster, fate: str) -> None:
    fake = cluster(Node(fate=fate), Node())
    assert judged() == {f"{index}.mcap": None for index in range(6)}
    assert fake.now_s < SILENCE_S + 5.0


def test_a_window_that_every_node_is_lost_with_is_a_row(cluster: Cluster) -> None:
    cluster(*(Node(fate="dies") for _ in range(4)))
    assert judged(1) == {"0.mcap": NODE_LOST}


@pytest.mark.fault("no Ray cluster", "none is started; the message says how to name or start one")
def test_without_a_cluster_none_is_started(cluster: Cluster) -> None:
    fake = cluster()
    with pytest.raises(FleetError) as raised:
        RayEngine(None, BOUNDS)
    for way_out in ("RAY_ADDRESS=HOST:6379", "--ray-address local", "--engine local"):
        assert way_out in str(raised.value)
    assert fake.addresses == ["auto"]


@pytest.mark.fault("nobody listens at the address of the Ray cluster", "an error at once, where Ray waits for ever")
def test_an_address_at_which_nobody_listens_is_an_error(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    fake = cluster(Node())
    with socket.socket() as bound:  # and not listening
        bound.bind(("127.0.0.1", 0))
        closed = f"127.0.0.1:{bound.getsockname()[1]}"
        for address in (closed, f"ray://{closed}"):
            with pytest.raises(FleetError, match=f"{closed}.*refused"):
                RayEngine(None, BOUNDS, address)
        current = tmp_path / "ray_current_cluster"
        current.write_text(f"{closed}\n")
        monkeypatch.setattr(engine_module, "CURRENT", current)
        with pytest.raises(FleetError, match="refused"):
            RayEngine(None, BOUNDS)
        monkeypatch.setenv("RAY_ADDRESS", closed)
        with pytest.raises(FleetError, match=closed):
            RayEngine(None, BOUNDS)
        assert fake.addresses == []
        bound.listen()
        RayEngine(None, BOUNDS)
        assert fake.addresses == [closed]


def test_a_cluster_whose_nodes_are_too_small_is_refused_at_once(cluster: Cluster) -> None:
    cluster(Node(), Node())
    with pytest.raises(FleetError, match=r"4096 MiB.*--memory"):
        RayEngine(None, WorkerLimits(600.0, 2**32))
    assert RayEngine(None, BOUNDS).cores == 2
    assert RayEngine(1, BOUNDS).cores == 1


@pytest.mark.parametrize(("version", "reason"), [(None, "No module coec"), ("0.0.1", "has coec 0.0.1")])
def test_a_node_without_this_version_of_coec_judges_nothing(cluster: Cluster, version: str | None, reason: str) -> None:
    cluster(Node(version=version), Node(version=version))
    with pytest.raises(FleetError, match=rf"{reason}.*every node needs coec {__version__}"):
        judged()
    cluster(Node(), Node(version=version))
    assert judged() == {f"{index}.mcap": None for index in range(6)}


@pytest.mark.fault("Ray nodes lack the folder with the windows", "the batch stops early and says so")
def test_paths_that_exist_only_here_stop_the_batch(cluster: Cluster, tmp_path: Path) -> None:
    jobs = [Job(str(tmp_path / f"{index}.mcap")) for index in range(9)]
    for job in jobs:
        Path(job.url).touch()
    cluster(Node(shares=False), Node(shares=False))
    with pytest.raises(FleetError, match="every node mounts"):
        judged(jobs=jobs)
    cluster(Node(shares=False))
    codes = judged(jobs=jobs, bounds=WorkerLimits(600.0, 2**30, alike=None))
    assert set(codes.values()) == {NOT_ON_NODE}
    # A path that does not exist here either is the window's own fault.
    assert judged(1) == {"0.mcap": SourceError.reply_code}


@pytest.mark.fault("store credentials are sent to Ray nodes", "never in what Ray writes into its log files")
def test_credentials_are_an_argument_and_not_in_the_runtime_environment(
    cluster: Cluster, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "AKIDEXAMPLE")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "the-secret")
    for send in (True, False):
        fake = cluster(Node())
        list(RayEngine(None, BOUNDS, send_credentials=send).rows([Job("s3://a/0.mcap")], ReplaySettings()))
        ((_, credentials),) = fake.arguments
        assert isinstance(credentials, StoreCredentials)
        assert ("the-secret" in credentials.values.values()) == send
        assert b"the-secret" not in pickle.dumps(fake.options)
        assert "the-secret" not in repr(fake.arguments)
