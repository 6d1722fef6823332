"""One session at a rig: locks, recovery after a crash, the sequence of trials, checks in between.

`open_session` opens a session: it locks the store and the rig, cleans up after a crash, and
builds the rig. `TrialCollector` takes trials and commits the good ones; between two of them it asks
`flows.collecting.supervisor`. None of them knows Prefect: `flows.collect` decides in what batches
trials are taken. The store is the only record of
progress, so a session may be killed at any instruction and the next one resumes.
"""

from __future__ import annotations

import platform
import shutil
import socket
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from typing import Protocol

from sliplab.analysis.quality import Assessment, Motion, assess
from sliplab.flows.collecting.live_feed import LiveFeed
from sliplab.flows.collecting.preparation import (
    announce,
    ask,
    change_over,
    find_zero,
    preparation_seconds,
    warm_up,
)
from sliplab.flows.collecting.requests import carry_out, end_if_stopped, store_lock
from sliplab.flows.collecting.supervisor import NO_LISTENER, CollectionSupervisor, SessionListener
from sliplab.flows.planning.campaign_trials import pending_trials
from sliplab.flows.planning.run_request import RunRequest, describe_campaign
from sliplab.flows.running import stopping
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.hashing import hash_integer
from sliplab.protocols.plugin import plugins
from sliplab.protocols.program import ACTING, Step
from sliplab.protocols.shown import plural
from sliplab.rigs.build import build_rig
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.rig import FORCE, Rig, StopRequested, TrialRun, ignore_step
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.rig_lock import held
from sliplab.storage.errors import translated_disk_errors
from sliplab.storage.files import sha256, sweep_temporary
from sliplab.storage.interrupts import interruptible, uninterrupted
from sliplab.storage.schema.trial import (
    Geometry,
    MotionStep,
    Provenance,
    RecordedTiming,
    StreamRecord,
    TrialQuality,
    TrialRecord,
)
from sliplab.storage.streams import Json, Sink
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.context import SKIN, LoggedContext, unplanned
from sliplab.storage.trials.recovery import recover
from sliplab.storage.trials.registration import registration_files
from sliplab.storage.trials.store import Campaign, SessionRecord, TrialStore
from sliplab.storage.trials.writer import TrialWriter
from sliplab.storage.versions import RECORDING, installed_versions

# an attempt is written without interruption, but a signal stops its motion at once
interruptible(Rig.run_trial)


def _ignore(trial: PlannedTrial) -> None:
    """Take no note of a trial that was committed."""


class Rounds(Protocol):
    """Decides between two rounds of trials which are next: what the hook `more_trials` opens."""

    def next_trials(self) -> list[PlannedTrial]:
        """Return the trials to take next; none at the end."""

    def committed(self, trial: PlannedTrial) -> None:
        """Take note of a trial that was just committed."""


@dataclass(frozen=True)
class CollectionSession:
    """An open session at the rig: the objects that run it and the trials to take.

    Attributes:
        rounds: of a protocol with claims, if they are evaluated.
        trials: pending trials that the run request asks for; with rounds, those of the first.
        left_out: number of pending trials that it does not ask for.
    """

    collector: TrialCollector
    supervisor: CollectionSupervisor
    trials: list[PlannedTrial]
    left_out: int = 0
    rounds: Rounds | None = None

    def more(self) -> list[PlannedTrial]:
        """Return the trials to take after all others: requested retakes, or the next round."""
        return self.supervisor.more() or ([] if self.rounds is None else self.rounds.next_trials())


@contextmanager
def open_session(
    run_request: RunRequest, listener: SessionListener = NO_LISTENER
) -> Iterator[CollectionSession]:
    """Open a session for a collection; the rig is closed when the block ends.

    Raises:
        Locked: another program collects into the store, or uses the rig.
        StoreError: its disk is full, read-only or failing.
        CampaignStopped: reference trials had drifted.
    """
    store = TrialStore.create(run_request.store)
    with store_lock(store, collects=run_request.campaign):
        end_if_stopped(store, run_request.since)
        campaign = _recover(store, run_request)
        end_if_stopped(store, run_request.since)  # by a stop that came before a signal could
        supervisor = CollectionSupervisor(run_request, store, campaign, listener=listener)
        supervisor.begin()
        feed = LiveFeed(run_request)
        # the rig is closed before results are computed
        with (
            feed.running(),
            held(run_request.rig, store.folder),
            _opened_rounds(run_request, store, campaign) as rounds,
            ExitStack() as opened,
        ):
            # a motion has no planned end that is certain, so the window ends whatever runs, but for
            # a plate that hangs on the sensor: the way out would drop it
            kind = "starting the fakes of" if run_request.rig.simulated else "opening"
            count = plural(sum(1 for _ in run_request.rig.drivers()), "device")
            announce(run_request.rig, f"{kind} {count}")
            rig = build_rig(
                run_request.rig,
                lambda: (
                    stopping.requested() or (supervisor.is_window_over() and not rig.holds_plate)
                ),
            )
            opened.callback(rig.close)  # at once: what follows writes to the store, and may fail
            logged = LoggedContext(store, campaign.name)
            campaign.add_bench_record(_session_record(run_request, campaign, logged.read()))
            collector = TrialCollector(
                run_request.plan,
                run_request.rig,
                rig,
                campaign,
                run_request.metadata.operator,
                on_trial=listener.on_trial_done,
                on_commit=_ignore if rounds is None else rounds.committed,
                supervisor=supervisor,
                context=logged.read,
                feed=feed,
            )
            trials = run_request.due_trials(campaign)
            left_out = len(pending_trials(run_request.plan, campaign)) - len(trials)
            if rounds is not None:
                trials = rounds.next_trials()[: run_request.most]
            yield CollectionSession(collector, supervisor, trials, left_out, rounds)


@contextmanager
def _opened_rounds(
    run_request: RunRequest, store: TrialStore, campaign: Campaign
) -> Iterator[Rounds | None]:
    if not run_request.has_claims:
        yield None
        return
    with plugins().hook("more_trials")(run_request, store, campaign) as rounds:
        yield rounds


def refresh(run_request: RunRequest) -> Campaign:
    """Recover the store and describe the campaign, where there is nothing to take.

    Claims are evaluated, too: a collection may have ended right after its last trial.
    """
    store = TrialStore.create(run_request.store)
    with store_lock(store):
        campaign = _recover(store, run_request)
        with _opened_rounds(run_request, store, campaign) as rounds:
            if rounds is not None:
                rounds.next_trials()
        return campaign


def _recover(store: TrialStore, run_request: RunRequest) -> Campaign:
    """Clean up after a crash, and carry out open requests."""
    clean_up(store)
    campaign = describe_campaign(store, run_request)
    recover(campaign)
    campaign.sweep()
    carry_out(store)
    return campaign


def clean_up(store: TrialStore) -> None:
    """Delete the temporary files that killed programs left outside the campaigns."""
    sweep_temporary(store.folder)
    sweep_temporary(store.folder / control.FOLDER)
    for name in ("models", "report", "derived", "review", "log", "pulled"):
        folder = store.folder / name
        for path in (folder, *folder.rglob("*")):
            if path.is_dir():
                sweep_temporary(path)


def _session_record(
    run_request: RunRequest, campaign: Campaign, logged: Mapping[str, str]
) -> SessionRecord:
    """Return the metadata of one session at the rig, as the store keeps it.

    Args:
        logged: context that people logged; its skin comes before the rig file's.
    """
    began = datetime.now(UTC)
    skin, metadata = run_request.rig.skin, run_request.metadata
    serial = logged.get(SKIN, skin.serial)
    made = skin.made if serial == skin.serial else None
    record: SessionRecord = {
        "began": began.isoformat(timespec="seconds"),
        "operator": metadata.operator,
        "temperature_c": metadata.temperature_c,
        "humidity_percent": metadata.humidity_percent,
        "note": metadata.note,
        "rig": run_request.rig.name,
        "sensor": run_request.rig.sensor,
        "skin": serial,
        "calibration": run_request.rig.calibration.model_dump(mode="json", exclude_none=True),
        "skin_age_days": None if made is None else (began.date() - made).days,
        "simulated": run_request.rig.simulated,
    }
    if registered := registration_files(campaign):
        record["registration"] = sha256(registered[-1])
    if run_request.has_claims and run_request.claims == "overrule":
        record["no_stopping"] = True
    return record


@dataclass
class TrialCollector:
    """Takes the trials of one plan on one rig into one campaign.

    Attributes:
        on_trial: called after each trial with it and ``committed``, ``set aside`` or ``skipped``.
        on_commit: called after each trial that was committed.
        supervisor: asked before each attempt and notified after each trial, if there is one.
        context: returns what people have logged by now of skin, temperature and so on, by name.
        feed: shows the trials to those who watch, if there is one.
        taken, retaken: attempts so far, and those of them that repeat one.
    """

    plan: Plan
    rig_file: RigFile
    rig: Rig
    campaign: Campaign
    operator: str = ""
    on_trial: Callable[[PlannedTrial, str], None] = NO_LISTENER.on_trial_done
    on_commit: Callable[[PlannedTrial], None] = _ignore
    supervisor: CollectionSupervisor | None = None
    context: Callable[[], dict[str, str]] = dict
    feed: LiveFeed | None = None
    taken: int = 0
    retaken: int = 0
    _previous: PlannedTrial | None = None
    _warm: bool = False
    _zero_slot: int | None = None
    _zero_sd_mm: float | None = None
    _logged: dict[str, str] = field(default_factory=dict)
    """Context of the attempt."""

    def take(self, trials: list[PlannedTrial]) -> None:
        """Take `trials`, and do before each what the protocol asks for.

        Raises:
            RigError: a device failed, or the operator did not carry out a request.
            StoreError: the store's disk is full, read-only or failing.
            CampaignStopped: the supervisor ended the campaign.
            WindowOver: the time window ended; the arm has been stopped and is clear.
            KeyboardInterrupt: a stop was requested.
        """
        for trial in trials:
            try:
                with translated_disk_errors(self.campaign.folder, RigError):
                    if not self._may_take(trial):
                        continue
                    self._prepare(trial)
                    self._take_with_retakes(trial)
            except StopRequested as stop:
                if self.supervisor is None or not self._by_window():
                    raise
                raise self.supervisor.window_over(
                    f"which stopped the arm before {trial.id} was complete"
                ) from stop
            self._previous = trial

    def fresh_start(self) -> None:
        """Forget all preparations: after a pause, plate, skin and depth zero may have changed."""
        self._previous, self._warm, self._zero_slot = None, False, None

    def _may_take(self, trial: PlannedTrial) -> bool:
        may = self.supervisor is None or self.supervisor.may_take(trial, self._due_s(trial))
        if self.supervisor is not None and self.supervisor.was_paused():
            self.fresh_start()
        before, self._logged = self._logged, unplanned(self.context(), self.plan)
        if before.get(SKIN) != self._logged.get(SKIN):
            self.fresh_start()
        if not may:
            self.on_trial(trial, "skipped")
        return may

    def _finish(self, trial: PlannedTrial, outcome: str) -> None:
        if outcome == "committed":
            self.on_commit(trial)
        self.on_trial(trial, outcome)
        if self.supervisor is not None:
            self.supervisor.after(trial, outcome)

    def _prepare(self, trial: PlannedTrial) -> None:
        """Do what the protocol asks for before this trial and this session has not done yet."""
        change_over(self.rig, self.plan, self._previous, trial)
        for task in self.plan.tasks_before(trial):
            if task.kind == "clean":
                ask(self.rig, task)
        self._warm_and_zero(trial)

    def _check_window(self, trial: PlannedTrial) -> None:
        """Check that the trial still fits into the window: what came before may have taken long."""
        if self.supervisor is not None:
            self.supervisor.check_window(trial, self._due_s(trial))

    def _by_window(self) -> bool:
        """Return whether the end of the time window, and no person, stopped the arm."""
        over = self.supervisor is not None and self.supervisor.is_window_over()
        return over and not stopping.requested()

    def _due_s(self, trial: PlannedTrial) -> float:
        """Return the planned time of warm-up and touches that are due before a trial, s."""
        zeroed = self.plan.rezero_task(trial).slot == self._zero_slot
        return preparation_seconds(self.rig, self.plan, warm=self._warm, zeroed=zeroed)

    def _warm_and_zero(self, trial: PlannedTrial) -> None:
        """Warm up the skin and find depth zero, unless that is done."""
        self._check_window(trial)  # a person may have taken hours
        maintenance = self.plan.protocol.collection.maintenance
        if maintenance.warm_up is not None and not self._warm:
            touches = maintenance.rezero is not None and self.rig.event_camera is not None
            step = "warming up the skin"
            announce(self.rig_file, f"touching off, {step}" if touches else step)
            warm_up(self.rig, self.plan, trial)
            self._warm = True
        if maintenance.rezero is not None and self.rig.event_camera is not None:
            slot = self.plan.rezero_task(trial).slot
            if slot != self._zero_slot:
                announce(self.rig_file, "touching off: depth zero")
                zero = find_zero(self.rig, self.plan, trial)
                self._zero_slot, self._zero_sd_mm = slot, None if zero is None else zero.sd_mm
        self._check_window(trial)

    def _take_with_retakes(self, trial: PlannedTrial) -> None:
        """Take one trial until it passes its gates or its retakes are used up."""
        retakes = self.plan.protocol.collection.gates.retakes
        number = self.campaign.attempts().get(trial.id, 0)
        failed = self.campaign.failed_attempts().get(trial.id, 0)
        self.retaken += number > 0  # by an earlier command
        while not self._attempt(trial, number):
            number += 1
            failed += 1
            if failed > retakes:
                self._finish(trial, "set aside")
                return
            if not self._may_take(trial):
                return
            change_over(self.rig, self.plan, self._previous, trial)  # only after a pause
            self._warm_and_zero(trial)
            self.retaken += 1
        self._finish(trial, "committed")

    @uninterrupted
    def _attempt(self, trial: PlannedTrial, number: int) -> bool:
        """Record one attempt at a trial; commit it, or quarantine it if it fails a gate.

        A signal stops the motion at once. One that comes before or after it waits: nothing moves
        then, and what was recorded completely is committed.
        """
        collection = self.plan.protocol.collection
        rate_hz = collection.recording.sync_rate
        frame_px, frame_rate_hz = (
            self.rig_file.frame_px(self.plan),
            self.rig_file.frame_rate_hz(self.plan),
        )
        with_events = self.rig_file.with_events(self.plan)
        mid_exposure_ns = None if frame_px is None else self.rig.frames.mid_exposure_ns
        spool = self.rig_file.frame_camera.spool
        writer = self.campaign.begin(trial.id, frame_px, frame_rate_hz, spool=spool)
        started = datetime.now(UTC)
        try:
            seed = hash_integer(trial.seed, number)
            stopping.check()
            sink, on_step = self._watched(trial, number, writer)
            run = self.rig.run_trial(
                self.plan.program(trial), sink, seed, frame_px, rate_hz, with_events, on_step
            )
            found = assess(
                writer.seal(),
                _motion(run),
                collection.gates,
                self.rig.timing,
                rate_hz,
                mid_exposure_ns,
                with_events=with_events,
                frame_rate_hz=frame_rate_hz,
                to_plate=self._to_plate(),
                further={device.name: device.about for device in self.rig.further},
            )
            record = self._record(trial, number, run, found, frame_px)
            provenance = self._provenance(started)
            self.taken += 1
            if found.passed:
                writer.commit(record, provenance)
            else:
                cause = {"cause": f"gate: {found.causes}", "trial": trial.id, "attempt": number}
                target = self.campaign.quarantine_path(trial.id)
                writer.quarantine(target, record, provenance, cause)
        except BaseException as error:
            self._abandon(writer, error)
            raise
        return found.passed

    def _watched(
        self, trial: PlannedTrial, number: int, writer: TrialWriter
    ) -> tuple[Sink, Callable[[Step], None]]:
        """Return the sink of an attempt, and what is called with each of its steps."""
        if self.feed is None:
            return writer, ignore_step
        camera = self.rig.event_camera
        event_px = None if camera is None else (camera.width, camera.height)
        return self.feed.begin(trial, number, writer, event_px), self.feed.on_step

    def _abandon(self, writer: TrialWriter, error: BaseException) -> None:
        """Quarantine the data written of a trial, with the cause, as far as the disk allows.

        What cannot be moved now is quarantined by the recovery of the next session. That commits
        a trial that has its record already, so such a folder stays.
        """
        with suppress(OSError, RuntimeError):
            writer.abandon()
        with suppress(OSError):
            if writer.folder.exists() and not (writer.folder / RECORD).exists():
                cause = "its time window ended" if self._by_window() else _cause(error)
                self.campaign.quarantine(writer.folder, cause)

    def _record(
        self,
        trial: PlannedTrial,
        attempt: int,
        run: TrialRun,
        found: Assessment,
        frame_px: tuple[int, int] | None,
    ) -> TrialRecord:
        """Return the trial's record: what follows from protocol, seed, versions and the log."""
        recorded = run.recorded_ns
        first, last = run.steps[0][0], run.steps[-1][0]
        record = TrialRecord(
            format=TrialRecord.FORMAT,
            trial=trial.id,
            campaign=self.campaign.name,
            experiment=self.plan.protocol.collection.experiment,
            role=trial.role,
            block=trial.block,
            repetition=trial.repetition,
            attempt=attempt,
            condition=self.plan.describe(trial),
            seed=trial.seed,
            rig=self.rig.name,
            simulated=self.rig_file.simulated,
            recorded_s=(recorded[1] - recorded[0]) / 1e9,
            motion_s=(last.end_ns - first.start_ns) / 1e9,
            depth_zero_mm=run.zero_mm,
            depth_zero_sd_mm=self._zero_sd_mm,
            counts=found.counts,
            clocks=found.clocks,
            timing=RecordedTiming(
                rig=self.rig.timing,
                rate_hz=self.plan.protocol.collection.recording.sync_rate,
                mid_exposure_ns=self.rig.frames.mid_exposure_ns if frame_px else None,
            ),
            quality=TrialQuality(passed=found.passed, gates=found.gates),
            steps=tuple(
                MotionStep(
                    phase=step.phase, start_ns=step.start_ns, end_ns=step.end_ns, recorded=recorded
                )
                for step, recorded in run.steps
            ),
            geometry=self._geometry(frame_px),
        )
        known = {
            "devices": self.rig.describe(),
            "simulation_truth": run.truth,
            "streams": _with_press(found.streams, run.pressed_mm),
            "context": self._logged,
        }
        return record.model_copy(update={name: value for name, value in known.items() if value})

    def _to_plate(self) -> tuple[tuple[float, float, float], ...] | None:
        """Return the rows of the matrix from the force sensor's axes to the plate's."""
        force = self.rig.force
        return None if force is None else self.rig.plate_frame.force_matrix(force.mounting)

    def _geometry(self, frame_px: tuple[int, int] | None) -> Geometry:
        with_events = self.rig_file.with_events(self.plan)
        geometry = Geometry(
            event_px=(self.rig.events.width, self.rig.events.height) if with_events else None,
            frame_px=frame_px,
            px_per_mm=self.rig_file.frame_camera.scale_px_per_mm,
            skin_mm=tuple(self.rig_file.skin.layout_mm()),
            centre=0,
        )
        centre = self.rig_file.calibration.centre_px
        return (
            geometry if centre is None else geometry.model_copy(update={"event_centre_px": centre})
        )

    def _provenance(self, started: datetime) -> Provenance:
        """Return when, where and with what the trial was taken: outside the checksums."""
        return Provenance(
            started=started.isoformat(timespec="milliseconds"),
            ended=datetime.now(UTC).isoformat(timespec="milliseconds"),
            host=socket.gethostname(),
            operator=self.operator,
            skin=self._logged.get(SKIN, self.rig_file.skin.serial),
            disk_free=shutil.disk_usage(self.campaign.folder).free,
            **_installed(),
        )


def _with_press(
    streams: dict[str, StreamRecord], pressed_mm: float | None
) -> dict[str, StreamRecord]:
    """Add the depth at which a press to a force ended to the figures of the forces."""
    if pressed_mm is None or FORCE not in streams:
        return streams
    known = streams[FORCE]
    figures = {**known.figures, "pressed_mm": round(pressed_mm, 4)}
    return {**streams, FORCE: known.model_copy(update={"figures": figures})}


def _motion(run: TrialRun) -> Motion:
    """Return what the assessment needs to know of a trial's motion."""
    moving = [step for step, _ in run.steps if step.phase in ACTING]
    return Motion(run.recorded_ns, (moving[0].start_ns, moving[-1].end_ns), run.path)


@cache
def _installed() -> Json:
    """Return what does not change while a program runs; finding it takes long."""
    return {
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": installed_versions(RECORDING),
    }


def _cause(error: BaseException) -> str:
    """Return why a trial ended early, for its quarantine."""
    # compiled code raises an unrelated error when a signal interrupts it
    if isinstance(error, (KeyboardInterrupt, StopRequested)) or stopping.requested():
        return "stopped by a person"
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
