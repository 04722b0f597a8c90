"""The daemon: runs the service in this process until it is told to stop. Builds the objects, starts the threads,
watches them, and ends them in order. If any thread dies, `health` says why and the process ends, so that the
service never goes on with a part missing.
"""

import logging
import os
import sys
import time
from collections.abc import Callable, Sequence
from typing import Literal

from coec import __version__
from coec.calibration.types import Reason
from coec.config import AuthorityConfig, Config, config_hash
from coec.errors import CoecError, ConfigError, ExitCode, ModelError, UnavailableError, UsageError
from coec.io import logs, system
from coec.io.disk_writer import DiskWriter
from coec.io.serialise import reasons_of
from coec.io.zenoh.bus import Answer, Bus, open_session
from coec.io.zenoh.command_auth import CommandListener, credentials_of
from coec.io.zenoh.ros_node import RosPublishers, RosSide
from coec.io.zenoh.session import Reach, connected_of, mode_of, redacted, settings_of, unguarded
from coec.io.zenoh.singleton import SingletonGuard, rival_text, unproven_text
from coec.schemas import replies
from coec.schemas.keys import Keys
from coec.service import ros_output as ros
from coec.service.api import metrics
from coec.service.api.authorization import Authority, CommandHandler, CommandRules
from coec.service.api.command_execution import PairCommands, RigCommands
from coec.service.api.metrics import LabelledHistogram, MetricsInput, TextFormat
from coec.service.api.metrics_server import MetricsServer, pages
from coec.service.api.pair_answers import PairAnswers, PendingPairAnswers
from coec.service.api.problems import RouterMonitor
from coec.service.api.reply_builders import SerializedReply, budget_status_of, worker_status_of
from coec.service.api.rig_answers import RigAnswers
from coec.service.api.routes import VehicleReplies, VehicleRoutes
from coec.service.api.uplink import Heartbeats, Uplink
from coec.service.camera_lidar_pair import CameraLidarPair
from coec.service.configuration import redacted_configuration, reload_of, settings_hash
from coec.service.cpu_budget import Budget
from coec.service.discovery import completed
from coec.service.engine.lidar_pairs import LidarPairs
from coec.service.engine.rig import RigEstimator
from coec.service.engine.vehicle import Vehicle
from coec.service.pending_pairs import PendingPairs
from coec.service.process_lifetime import FolderLock, Signals, attempt, handled_signals, joined, locked, stopped
from coec.service.recording.recorder import RecordingThread
from coec.service.recording.snippets import SnippetStore
from coec.service.recording.window_store import WindowStore
from coec.service.records.state_store import StateStore
from coec.service.ros_output import RosOutputs
from coec.service.vehicle_context import VehicleContext
from coec.service.worker.supervisor import Worker, WorkerState

_log = logging.getLogger(__name__)

TOKENS_HIDDEN = Reason(
    "tokens_hidden",
    "The router hides the liveliness tokens of this vehicle: a second daemon could serve it unseen. Its rules must "
    "allow the service `liveliness_token` and `liveliness_query` (deploy/router.json5).",
)

CERTIFICATE = "authority.certificate"
"""Name under which a reload lists the certificate: its files may change while the configuration does not."""

TICK_S = 1.0

GIVE_BACK_S = 5.0
"""Time between two returns of unused memory to the system, s. Memory that new frames use again within this time need
not be cleared by the system first."""

STALLED_S = 20.0
"""A thread that gives no beat for so long is stuck, s. The watchdog of the service manager is then no longer fed, and a
start gets no more time."""

# With these time limits, and because the worker is killed, the service ends in less than 15 s.
ENGINE_STOP_S, RECORDER_STOP_S, DISK_WRITER_STOP_S = 2.5, 4.0, 1.5
QUERIES_STOP_S, HTTP_STOP_S, ROS_STOP_S, LISTENER_STOP_S, SESSION_STOP_S, WORKER_STOP_S = 1.0, 0.5, 0.5, 1.5, 2.5, 1.0


def exit_code_of(error: CoecError) -> ExitCode:
    """The exit status of a service that ends with an error: whether a later start may succeed or only a person can cure
    it. What commands report as failed work, such as a folder of windows that cannot be made, is a matter of the disk
    here."""
    wrong = isinstance(error, ConfigError | ModelError | UsageError)
    return ExitCode.CONFIGURATION if wrong else ExitCode.UNAVAILABLE


class Daemon:
    """Composes the service from its parts."""

    def __init__(self, config: Config, notifier: system.ServiceManagerNotifier, lock: FolderLock) -> None:
        """Builds everything and opens the Zenoh session. No thread runs yet. `lock` is that of the state directory.

        Raises:
            ConfigError: a rig, an endpoint or a certificate cannot be used.
            UnavailableError: a port is taken.
            RecordingError: the state directory cannot be used.
        """
        self._pending_pairs = PendingPairs(config, config.state.directory)
        config = self._config = self._pending_pairs.complete(config)
        self._notifier = notifier
        self._started_s, self._started_ns = time.monotonic(), time.time_ns()
        self._given_back_s = self._progress_s = self._started_s
        self._state: Literal["starting", "running", "stopping", "failing"] = "starting"
        self._fault: Reason | None = None
        self._keys = Keys(config.prefix, config.vehicle)
        self._folder = WindowStore(config.state.directory / "windows", config.state)
        self._budget = Budget(config.budget)
        self._worker = Worker(config.worker, config.model_dump_json(), pay=self._budget.pay)
        settings = settings_of(config.zenoh, config.limits)
        self._insecure = _insecure(unguarded(settings))
        self._reach = Reach(settings)
        self._rules = self._rules_of(config.authority, None)
        self._open_network(config, () if mode_of(settings) == "router" else connected_of(settings))
        self._build_pairs(config, lock)

    def _open_network(self, config: Config, endpoints: Sequence[str]) -> None:
        """Opens the Zenoh session, and builds what uses it. `endpoints` are the routers that it connects to."""
        session = open_session(config.zenoh, config.limits)
        self._bus = Bus(session)
        self._ros_side = RosSide(session, config)
        self._presence = SingletonGuard(session, config.zenoh, config.limits, self._keys, self._started_ns)
        self._router = RouterMonitor([redacted(endpoint) for endpoint in endpoints], self._bus.reaches_somebody)
        self._metrics_server = MetricsServer(pages(self._metrics, self._health, self._is_alive))
        node = self._ros_side.node
        publishers = None if node is None else RosPublishers(session, node)
        self._ros_outputs = RosOutputs(publishers, config, self._worker)

    def _build_pairs(self, config: Config, lock: FolderLock) -> None:
        """Builds the pairs, what they share, and what answers queries about them."""
        store = StateStore(config.state.directory, config.vehicle)
        self._disk_writer = DiskWriter(config.state.directory)
        self._disk_writer.register(lock, self._folder)
        self._rig_answers = RigAnswers(self._keys, self._publish)
        rig = RigEstimator(config.state.directory, config.links, self._disk_writer)
        self._vehicle = Vehicle(
            config.limits, self._budget, rig, self._rig_answers.on_update, config.snippets.memory_bytes
        )
        self._disk_writer.on_written(self._vehicle.inbox.wake)  # what waits for the disk can be published
        self._recording = RecordingThread()
        snippets = _snippets_of(config)
        if snippets is not None:
            self._disk_writer.register(snippets)
        self._context = VehicleContext(
            keys=self._keys,
            vehicle=self._vehicle,
            store=store,
            disk_writer=self._disk_writer,
            folder=self._folder,
            recording=self._recording,
            worker=self._worker,
            publish=self._publish,
            vehicle_problems=self._problems,
            show=self._ros_outputs.show,
            topics=self._ros_side.topics,
            nominal=self._pending_pairs.nominal,
            rig_problems=self._rig_answers.problems,
            snippets=snippets,
        )
        self._pairs = {pair.name: CameraLidarPair(pair, config, self._context) for pair in config.pairs}
        self._lidars = LidarPairs(config.lidar_edges, self._vehicle, self._worker)
        self._lidars.grow(config.pairs)
        while self._vehicle.turn(0.0):  # so that a reply exists before the first query
            pass
        pending = self._pending_pairs.open(config, self._context)
        self._commands: dict[str, PairCommands] = {
            **{name: pair.commands for name, pair in self._pairs.items()},
            **{name: answers.commands for name, answers in pending.items()},
        }
        of_rig = RigCommands(config.vehicle, self._commands, self._rig_answers)
        self._command_handler = CommandHandler(self._rules, self._commands, of_rig)
        self._configuration = replies.ConfigurationStatus(read_ns=self._started_ns)
        self._heartbeats = Heartbeats(self._keys, __version__, config.uplink, self._bus.publish)
        self._uplink = Uplink(config.uplink)
        self._status = self._status_now()
        self._replies = VehicleReplies(SerializedReply.of(self._status), self._config_reply())
        self._answers = VehicleRoutes(
            self._keys,
            {**{name: pair.answers for name, pair in self._pairs.items()}, **pending},
            self._command_handler,
            self._replies,
            self._metrics,
            self._rig_answers,
            self._heartbeats,
            self._uplink,
        )

    def serve(self, signals: Signals, reread: Callable[[], Config] | None) -> int:
        """Run until a signal or a fault; returns the exit status."""
        status = 0
        try:
            self._presence.claim(signals.stop)
            self._start()
            while status == 0 and not signals.stop.wait(TICK_S):
                status = self._tick()
                if signals.reread.is_set():
                    signals.reread.clear()
                    self._reload(reread)
        except CoecError as error:
            _log.error(str(error), extra={"fields": {"code": error.reply_code}})
            status = exit_code_of(error)
        except Exception:
            _log.exception("the main loop failed")
            status = ExitCode.FAULT
        finally:
            if not self._stop():
                logging.shutdown()
                os._exit(status)  # a thread of Zenoh is stuck and would keep the process alive for ever
        return status

    # --- start, tick, stop ------------------------------------------------------------------------------------------

    def _start(self) -> None:
        for thread in (
            self._disk_writer.thread,
            self._recording.thread,
            self._presence.thread,
            self._vehicle.thread,
            *self._bus.threads,
        ):
            thread.start()
        self._ros_outputs.start(self._ros_status)
        _log.info("worker starting; on the first start on a machine it compiles its kernels for about a minute")
        self._worker.start()
        self._answers.declare(self._bus)
        self._metrics_server.reconfigure(self._config.metrics)
        self._subscribe()
        self._pending_pairs.listen(self._bus, self._ros_side)
        for name in (each.name for each in self._config.every_pair):
            self._bus.declare_alive(self._keys.alive(name))
        fields = {"vehicle": self._config.vehicle, "config_hash": self._status.config_hash}
        _log.info(
            "serving",
            extra={
                "fields": {
                    **fields,
                    "pairs": list(self._pairs),
                    "awaited": list(self._pending_pairs.answers),
                    "left_out": list(self._config.left_out),
                }
            },
        )

    def _subscribe(self) -> None:
        """Subscribes to the streams of all pairs that are not subscribed to yet."""
        for stream, take in self._vehicle.new_streams():
            self._bus.subscribe(self._ros_side.input_of(stream), take)

    def _admit(self) -> None:
        """Builds and starts the awaited pairs whose configuration is complete by now."""
        discovered = self._pending_pairs.pop_discovered()
        if not discovered:
            return
        whole = completed(self._config, discovered)
        self._worker.reconfigure(whole.model_dump_json())
        fresh = {name: CameraLidarPair(config, whole, self._context) for name, config in discovered.items()}
        self._pairs = {**self._pairs, **fresh}  # first, because the configuration names them
        self._config = whole
        self._lidars.grow(whole.pairs)
        for name, pair in fresh.items():
            self._commands[name] = pair.commands
            self._answers.replace(pair.answers)
        self._subscribe()
        self._command_handler.reconfigure(self._rules)  # for the commands of new pairs, too
        self._replies.config = self._config_reply()
        fields = {"pairs": list(discovered), "config_hash": config_hash(self._config)}
        _log.info("discovered pairs are served", extra={"fields": fields})

    def _tick(self) -> int:
        """Runs once a second: looks at every thread, renews what is served, and returns unused memory to the system.
        Returns an exit status; 0: go on."""
        if time.monotonic() - self._given_back_s >= GIVE_BACK_S:
            system.trim_heap()
            self._given_back_s = time.monotonic()
        threads = self._threads()
        dead = [thread for thread in threads if thread.dead]
        if dead:
            self._fault = Reason("thread_died", f"The thread {dead[0].name} died: {dead[0].failure!r}.")
        elif self._presence.rival is not None:
            self._fault = Reason("two_daemons", rival_text(self._config.vehicle, self._presence.rival))
        elif self._worker.unusable is not None:
            self._fault = self._worker.unusable
        elif self._state == "starting" and self._worker.status().state is not WorkerState.STARTING:
            self._state = "running"
            self._notifier.ready()
            _log.info("ready: the worker is warm")
        if self._fault is None:
            self._admit()
        else:
            self._state = "failing"
            _log.error(self._fault.text, extra={"fields": {"code": self._fault.code}})
            for pair in self._pairs.values():
                pair.answers.fail(self._fault)
            self._pending_pairs.fail(self._fault)
        self._router.check()
        self._renew()
        if self._fault is not None:
            if dead:
                return ExitCode.FAULT
            # Without a rival it is the worker that cannot use the configuration.
            return ExitCode.CONFIGURATION if self._presence.rival is None else ExitCode.UNAVAILABLE
        if all(thread.silence_s < STALLED_S for thread in self._prompt_threads()):
            self._progress_s = time.monotonic()
            self._notifier.watchdog(None if self._metrics_server.server is None else self._config.metrics.address)
            if self._state == "starting":
                self._notifier.starting(STALLED_S)
        return 0

    def _stop(self) -> bool:
        """Ends everything in order; False if the session did not close in time. If a step raises, the next ones still
        run."""
        _log.info("stopping")
        if self._state != "failing":
            self._state = "stopping"
        steps: tuple[tuple[str, Callable[[], object]], ...] = (
            ("announce", self._notifier.stopping),
            ("tell", self._renew),
            ("take no more samples", self._bus.undeclare_inputs),
            ("look for no more pairs", lambda: stopped(self._pending_pairs.threads, LISTENER_STOP_S)),
            ("end the engine", lambda: _end(self._vehicle, ENGINE_STOP_S)),
            ("finish the open windows", self._finish_windows),
            ("end the recorders", lambda: _end(self._recording, RECORDER_STOP_S)),
            ("end the worker", self._worker.request_stop),
            ("take the last outcomes", self._finish_pairs),
            ("write all that is to be remembered", lambda: _end(self._disk_writer, DISK_WRITER_STOP_S)),
            ("end the answers", lambda: stopped(self._bus.threads, QUERIES_STOP_S)),
            ("stop serving HTTP", lambda: self._metrics_server.close(HTTP_STOP_S)),
            ("stop publishing to ROS", lambda: self._ros_outputs.close(ROS_STOP_S)),
            ("withdraw the answers", self._bus.undeclare_queryables),
            ("leave the ROS graph", self._ros_side.close),
        )
        for name, step in steps:
            attempt(name, step)
        guard_closed = attempt("look for no other daemon", lambda: self._presence.close(LISTENER_STOP_S))
        closed = attempt("close the session", lambda: self._bus.close(SESSION_STOP_S))
        attempt("wait for the worker", lambda: joined([self._worker.thread], WORKER_STOP_S))
        _log.info("stopped", extra={"fields": {"session_closed": closed}})
        return bool(guard_closed and closed)

    def _finish_windows(self) -> None:
        """Finishes the open windows if the engine has ended. While it runs, only its thread may touch them."""
        if self._vehicle.thread.join(0.0):
            for pair in self._pairs.values():
                attempt("finish a window", pair.finish_window)

    def _finish_pairs(self) -> None:
        """Takes the outcomes that have come since the engine ended, and saves what is known."""
        if self._vehicle.thread.join(0.0):
            attempt("take the last outcomes", self._vehicle.finish)
            for pair in self._pairs.values():
                attempt("save the state", pair.engine.store.save)

    def _reload(self, reread: Callable[[], Config] | None) -> None:
        """On SIGHUP: reads the configuration again and takes over what can change without a restart. A file with which
        the service could not start changes nothing."""
        if reread is None:
            _log.warning("no configuration file to reload")
            return
        self._notifier.reloading()
        previous = self._configuration
        try:
            fresh = reload_of(self._config, self._pending_pairs.complete(reread()))
            rules = self._rules_of(fresh.config.authority, self._rules.listener)
        except Exception as error:  # whatever is wrong with the file, the running service goes on
            self._configuration = previous.model_copy(update={"read_ns": time.time_ns(), "refused": str(error)})
            expected = isinstance(error, CoecError)
            _log.error(
                f"the changed configuration is invalid, the previous one remains in force: {error}",
                exc_info=not expected,
            )
        else:
            taken = fresh.taken
            if rules.digest != self._rules.digest and CERTIFICATE not in taken:
                taken = (*taken, CERTIFICATE)
            self._configuration = replies.ConfigurationStatus(
                read_ns=time.time_ns(), reloads=previous.reloads + bool(taken), taken=taken, waiting=fresh.waiting
            )
            self._reconfigure(fresh.config, rules)
            changed = "it is taken" if taken else "it changes nothing that runs"
            waits = "; what differs besides waits for a restart" if fresh.waiting else ""
            places = {"taken": list(taken), "waiting": list(fresh.waiting)}
            fields = {**places, "config_hash": config_hash(self._config)}
            _log.info(f"the configuration on the disk is valid; {changed}{waits}", extra={"fields": fields})
        self._renew()
        if self._state == "running":
            self._notifier.ready()

    def _rules_of(self, config: AuthorityConfig, before: CommandListener | None) -> CommandRules:
        """Who may give commands, according to the files as they are now. Conversations of the listener `before` go on.

        Raises:
            ConfigError: a file cannot be used.
        """
        credentials, authority = credentials_of(config), Authority(config, self._reach.exposure)
        if credentials is None:
            return CommandRules(authority, None)
        return CommandRules(authority, CommandListener(credentials) if before is None else before.renewed(credentials))

    def _reconfigure(self, config: Config, rules: CommandRules) -> None:
        """Goes on with another configuration and its rules. It differs only in what can change without a restart."""
        before, self._config = self._config, config
        self._rules = rules
        self._command_handler.reconfigure(rules)  # even if nothing differs, because certificates are renewed in place
        self._metrics_server.reconfigure(config.metrics)  # even if nothing differs, because its port may be free by now
        if config == before:
            return
        logs.configure(config.log.level, config.log.format)
        self._folder.reconfigure(config.state)
        self._budget.reconfigure(config.budget)
        self._uplink.reconfigure(config.uplink)
        self._heartbeats.reconfigure(config.uplink)
        self._replies.config = self._config_reply()
        for old, new in zip(before.pairs, config.pairs, strict=True):
            if old == new and before.stale_after_s == config.stale_after_s:
                continue
            hashes = f"settings {settings_hash(old)}, now {settings_hash(new)}; service {config_hash(config)}"
            history_text = f"The configuration was read again: {hashes}."
            self._pairs[new.name].reconfigure(new, config.stale_after_s, history_text)

    # --- what the parts ask of the whole ----------------------------------------------------------------------------

    def _publish(self, key: str, answer: Answer) -> None:
        self._bus.publish(key, answer)
        self._ros_outputs.wake()

    def _problems(self) -> tuple[Reason, ...]:
        """Troubles that concern every pair alike."""
        worker = self._worker.status()
        failing = worker.failure if worker.state is WorkerState.STARTING else None
        compiling = None if worker.compiling is None else worker.compiling.reason
        hidden = TOKENS_HIDDEN if self._presence.hidden else None
        tokens = self._presence.unproven
        unproven = Reason("rival_unproven", unproven_text(tokens)) if tokens else None
        own = (
            self._disk_writer.problem,
            self._insecure,
            hidden,
            unproven,
            self._router.problem,
            self._metrics_server.insecure,
        )
        return tuple(reason for reason in (self._fault, failing, compiling, *own) if reason is not None)

    # --- status -----------------------------------------------------------------------------------------------------

    def _threads(self) -> list[system.ServiceThread]:
        """All of them."""
        door = [] if self._metrics_server.server is None else [self._metrics_server.server.thread]
        waiting = [thread for thread in self._bus.threads if thread not in self._bus.prompt_threads]
        return [*self._prompt_threads(), self._disk_writer.thread, *waiting, *door, self._recording.thread]

    def _prompt_threads(self) -> list[system.ServiceThread]:
        """The threads that never wait for a disk. Only these must beat: a thread that waits for a slow disk may stand
        still as long as the disk takes. `health` reports that, and a restart would not make the disk quicker."""
        of_ros = (*self._pending_pairs.threads, *self._ros_outputs.threads)
        return [self._presence.thread, *self._bus.prompt_threads, self._worker.thread, *of_ros, self._vehicle.thread]

    def _renew(self) -> None:
        self._pending_pairs.renew()
        self._status = self._status_now()
        self._replies.status = SerializedReply.of(self._status)
        self._heartbeats.renew(self._state, self._status.config_hash, self._answering())

    def _status_now(self) -> replies.StatusReply:
        usage = self._folder.usage()
        own = tuple(reason for reason in (self._metrics_server.problem, self._lidars.problem) if reason is not None)
        return replies.StatusReply(
            version=__version__,
            vehicle=self._config.vehicle,
            state=self._state,
            reasons=reasons_of((*self._problems(), *own)),
            started_ns=self._started_ns,
            uptime_s=time.monotonic() - self._started_s,
            config_hash=config_hash(self._config),
            configuration=self._configuration,
            pairs=tuple(answers.status() for answers in self._answering()),
            worker=worker_status_of(self._worker),
            budget=budget_status_of(self._budget.report()),
            storage=replies.StorageStatus(
                bytes_used=usage.used,
                bytes_free=usage.free,
                losses={"windows_removed": self._folder.removed} if self._folder.removed else {},
            ),
            queries_waiting=self._bus.waiting,
        )

    def _config_reply(self) -> SerializedReply:
        """The configuration as it is served."""
        return SerializedReply.of_document(
            {
                "schema_version": 1,
                "config_hash": config_hash(self._config),
                "config": redacted_configuration(self._config),
                "found": self._pending_pairs.origins(),
            }
        )

    def _ros_status(self) -> ros.VehicleOutput:
        """The present state, from which the messages to ROS are made."""
        serials = {pair.name: pair.camera.hardware_id for pair in self._config.every_pair}
        return ros.VehicleOutput(
            self._state,
            tuple(
                ros.PairOutput(answers.health_reply, serials[answers.name], answers.extrinsic_reply, answers.rig)
                if isinstance(answers, PairAnswers)
                else ros.PairOutput(answers.health_reply, serials[answers.name], None, None)
                for answers in self._answering()
            ),
            self._rig_answers.reply if len(self._pairs) > 1 else None,
        )

    def _health(self) -> tuple[replies.StatusReply, dict[str, replies.HealthReply]]:
        """The status of the service, and the health of every pair."""
        return self._status, {answers.name: answers.health_reply for answers in self._answering()}

    def _answering(self) -> list[PairAnswers | PendingPairAnswers]:
        """The answers of every pair: running pairs first, then the awaited ones."""
        return [*(pair.answers for pair in self._pairs.values()), *self._pending_pairs.answers.values()]

    def _is_alive(self) -> bool:
        """Whether the main loop runs and no thread is stuck, by the measure of the watchdog."""
        return time.monotonic() - self._progress_s < STALLED_S

    def _metrics(self, text_format: TextFormat = TextFormat.OPEN_METRICS) -> bytes:
        pairs = self._pairs.items()
        took = {
            metrics.QUERY: [LabelledHistogram((), self._answers.took)],
            metrics.DECODE: [
                LabelledHistogram((sensor.config.sensor,), sensor.took) for sensor in self._vehicle.sensors
            ],
            metrics.PAIR_WAIT: [LabelledHistogram((name,), pair.stream.waiting_took) for name, pair in pairs],
            metrics.WRITE: [LabelledHistogram((name,), pair.recorder.writing_took) for name, pair in pairs],
            metrics.JOB: [LabelledHistogram((), self._worker.jobs_took)],
            metrics.WORK: [LabelledHistogram((), self._worker.work_took)],
        }
        memory = (system.resident_bytes(), self._worker.status().rss_bytes)
        view = MetricsInput(*self._health(), *memory, took, self._rig_answers.reply, self._uplink)
        return metrics.render(view, text_format)


def _end(part: Vehicle | RecordingThread | DiskWriter, timeout_s: float) -> None:
    """Ends a part with a thread of its own."""
    part.request_stop()
    joined([part.thread], timeout_s)


def _snippets_of(config: Config) -> SnippetStore | None:
    """The store for the seconds around events; None if the configuration asks for none."""
    if config.snippets.memory_bytes == 0:
        return None
    return SnippetStore(config.state.directory / "snippets", config.snippets.max_bytes, config.state.min_free_bytes)


def _insecure(doors: Sequence[str]) -> Reason | None:
    """The trouble to report if endpoints accept anybody (`doors`); None if there is no such endpoint."""
    if not doors:
        return None
    text = (
        f"Whoever reaches {', '.join(doors)} can read and send frames without a certificate, and give commands if "
        "`authority.anonymous` is `always`: `zenoh.insecure` is set. Listen on loopback, or on tls with client "
        "certificates."
    )
    return Reason("insecure", text)


SWITCH_INTERVAL_S = 0.0005
"""How long a thread may keep the interpreter while a query waits. Python's default of 5 ms would be half of the time
that a query may take."""


def run(config: Config, reread: Callable[[], Config] | None = None) -> int:
    """Serve until SIGTERM or SIGINT; returns the exit status. `reread` reads the configuration again on SIGHUP."""
    logs.configure(config.log.level, config.log.format)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        with handled_signals() as signals, locked(config.state.directory) as lock:
            return Daemon(config, system.ServiceManagerNotifier.from_environment(), lock).serve(signals, reread)
    except CoecError as error:
        _log.error(str(error), extra={"fields": {"code": error.reply_code}})
        return exit_code_of(error)
    except OSError as error:
        # Of the disk, as what it says is not foreseen: a full one, a failing one.
        _log.exception(f"the service cannot start: {error}", extra={"fields": {"code": UnavailableError.reply_code}})
        return ExitCode.UNAVAILABLE
