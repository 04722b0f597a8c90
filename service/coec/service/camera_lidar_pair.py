"""One camera-LiDAR pair: its parts, and how it starts and ends. No logic.

Three threads work for a pair, and each is the only writer of its part:

- the intake's thread, which all pairs of a vehicle share, owns samples, pairs of frames, and what each is used for,
- the recorder's thread owns files,
- the decider's thread owns answers, commands and ages.

The threads reach each other through the inbox (intake), the recorder's queue and the mailbox (decider). The worker's
results come back through the mailbox, too.
"""

import logging

from coec.config import CalibrationConfig, Config, PairConfig
from coec.io.logs import LossCounter
from coec.io.rig_files import rig_of
from coec.service.api.command_execution import Commands
from coec.service.api.pair_answers import PairAnswers
from coec.service.configuration import settings_hash
from coec.service.engine.frame_selector import FrameSelector
from coec.service.engine.job_client import IncidentPictures, JobClient
from coec.service.engine.pair import CalibrationManager
from coec.service.engine.pair_stream import PairStream
from coec.service.engine.schedule import ResultSchedule
from coec.service.ingest.frame_buffers import FrameRing
from coec.service.recording.recorder import Recorder, RecordingPlan
from coec.service.recording.snippets import SnippetRecorder
from coec.service.records.pair_store import PairStore
from coec.service.records.rig_store import RigBaseline
from coec.service.task_queue import TaskQueue
from coec.service.vehicle_context import VehicleContext

_log = logging.getLogger(__name__)


class Pair:
    """One pair. `stream` runs on the intake's thread, `recorder` and `decider` each on their own. Any thread may use
    `answers` and `commands`."""

    def __init__(self, pair: PairConfig, config: Config, context: VehicleContext) -> None:
        """Builds the pair and recalls its state from the disk.

        Raises:
            ConfigError: the rig cannot be built.
        """
        self.name = pair.name
        rig, folder = rig_of(pair), context.folder
        losses = LossCounter(_log, pair.name)
        task_queue, queue = TaskQueue(), ResultSchedule(lambda: context.worker.compiled_s)
        store = PairStore(rig, config.vehicle, config.state, context.store, context.disk_writer, folder, losses)
        of_rig = context.rig.join(pair, rig.T_camera_lidar_nominal, store.state, lambda: queue.unanswered == 0)
        job_client = JobClient(pair, queue, context.worker, context.budget, task_queue, folder, of_rig, context.show)
        baseline = RigBaseline(pair, rig, config.state)
        context.disk_writer.register(baseline)
        self._rig, self._vehicle, self._packed = rig, config.vehicle, config.state.packing == "lz4"
        plan = self._plan(pair, baseline.calibration)
        snippets = self._snippets_of(plan, context, losses)
        self.recorder = Recorder(plan, folder, losses, job_client.solve, job_client.lost, snippets)
        first_slice_s = context.budget.join(pair.name, pair.monitor, pair.window)
        selector = FrameSelector(
            pair, config.limits, rig, store.served, job_client, self.recorder, losses, first_slice_s, store.carried_over
        )
        ring = None if snippets is None else FrameRing(config.snippets, _ring_bytes(config), snippets.submit)
        self.stream = PairStream(pair, config, context.intake, selector, lambda: self.recorder.has_room, losses, ring)
        self.answers = PairAnswers(
            pair, config, rig, store, folder, self.recorder, self.stream, context, lambda: self.commands.counts
        )
        pictures = IncidentPictures(store.add_picture, folder, job_client, losses)
        self.manager = CalibrationManager(
            pair,
            config.stale_after_s,
            store,
            baseline,
            queue,
            pictures,
            self.stream,
            of_rig,
            task_queue,
            losses,
            self.recorder.reconfigure,
            self.answers.on_update,
        )
        job_client.connect(self.manager)
        self.commands = Commands(
            pair,
            config.vehicle,
            rig,
            self.manager,
            task_queue,
            store,
            self.stream,
            selector,
            self.recorder,
            folder,
            job_client,
        )
        self._selector, self._job_client, self._task_queue = selector, job_client, task_queue
        self.manager.publish()

    def reconfigure(self, pair: PairConfig, stale_after_s: float, history_text: str) -> None:
        """Goes on with other settings, which differ only in what `reload.RELOADED` names. `told` is the entry for the
        history. Called on the main thread; each part takes over its settings on the thread that owns them."""
        self._job_client.reconfigure(pair)
        self.answers.reconfigure(pair)
        self.commands.reconfigure(pair)
        self.recorder.follow(self._plan(pair, pair.calibration))
        self.stream.call(lambda: self._selector.reconfigure(pair.window))
        self._task_queue.post(lambda: self.manager.reconfigure(pair, stale_after_s, history_text))

    def _plan(self, pair: PairConfig, calibration: CalibrationConfig) -> RecordingPlan:
        metadata = {"vehicle": self._vehicle, "pair": pair.name, "settings_hash": settings_hash(pair)}
        return RecordingPlan(self._rig, calibration, pair.window.min_pairs, metadata, self._packed)

    @staticmethod
    def _snippets_of(plan: RecordingPlan, context: VehicleContext, losses: LossCounter) -> SnippetRecorder | None:
        if context.snippets is None:
            return None
        return SnippetRecorder(plan.rig, plan.metadata, context.snippets, losses, packed=plan.packed)

    def finish_window(self) -> None:
        """Ends the open window when the service ends; called after the intake's thread has ended."""
        self.stream.finish_snippet()
        self.stream.finish_pairs()
        self._selector.finish()


def _ring_bytes(config: Config) -> int:
    """Size of one pair's ring: half of the pair's share, because as much again is in memory while a snippet is
    written."""
    return config.snippets.memory_bytes // (2 * max(len(config.every_pair), 1))
