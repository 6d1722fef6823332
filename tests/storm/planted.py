"""Small defects of the product, planted one at a time: does the storm find them?

Each is a patch of this process, made before a story is played. What it breaks is its docstring.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from sliplab.analysis import quality, references
from sliplab.analysis.clocks import synchronise
from sliplab.flows import status
from sliplab.flows.collecting import requests, session, supervisor, watches
from sliplab.plugins.alerts import outbox
from sliplab.plugins.record import recorder
from sliplab.plugins.web.server import runs
from sliplab.rigs.core import force_watch, guard, motion_watch, rig
from sliplab.rigs.core.capabilities import ArmState
from sliplab.storage import files
from sliplab.storage.remote import objects, pull
from sliplab.storage.remote import push as pushing
from sliplab.storage.streams import EventChunk, NullSink
from sliplab.storage.trials import control, hdf5_writer, journal, recovery, store, writer

PLANTS: dict[str, Callable[[], None]] = {}


def plant(function: Callable[[], None]) -> Callable[[], None]:
    """Enter a defect in the table."""
    PLANTS[function.__name__] = function
    return function


def nothing(*given: Any, **named: Any) -> None:
    """Do nothing, whatever is given."""


# -- store ---------------------------------------------------------------------------------------


@plant
def commit_unflushed() -> None:
    """The rename that commits a trial is not flushed: a power cut takes the trial back."""
    for module in (writer, recovery):
        module.make_visible = lambda folder, target: os.rename(folder, target)  # type: ignore[attr-defined]


@plant
def data_unflushed() -> None:
    """A trial's data are not flushed before its record is written."""
    writer.sync_file = nothing  # type: ignore[attr-defined]


@plant
def recovery_trusts() -> None:
    """Recovery commits whatever has a record, whole or not."""
    recovery._problems = lambda check: False


@plant
def again_deletes() -> None:
    """A trial that is wanted again is deleted."""
    quarantine = store.Campaign.quarantine

    def deleting(campaign: store.Campaign, folder: Path, cause: str, **more: object) -> Path:
        if cause.startswith(store.AGAIN):
            shutil.rmtree(folder)
            return folder
        return quarantine(campaign, folder, cause, **more)

    store.Campaign.quarantine = deleting  # type: ignore[method-assign]


@plant
def journal_reuses() -> None:
    """The number of a request that comes second replaces the first one's file."""

    def add(self: journal.Journal, number: int, data: Any) -> bool:
        files.make_folder(self.folder)
        files.write_json(self.path(max(number - 1, 1)), data)
        return True

    journal.Journal.add = add  # type: ignore[method-assign]


@plant
def left_open() -> None:
    """A handle of the trials' folder stays open after each commit."""
    sync_folder = writer.sync_folder

    def leaking(folder: Path) -> None:
        os.open(folder, os.O_RDONLY)
        sync_folder(folder)

    writer.sync_folder = leaking  # type: ignore[attr-defined]


@plant
def manifest_first() -> None:
    """The manifest of a trial is pushed before its files."""
    send = pushing._Push._send

    def early(self: Any, made: Any, folder: Path, existing: Any) -> bool:
        self.remote.put(made.key, made.dump())
        return send(self, made, folder, existing)

    pushing._Push._send = early  # type: ignore[method-assign]


@plant
def pull_unchecked() -> None:
    """What is pulled becomes visible although files of it are missing."""

    def get(self: objects.Remote, key: str, path: Path, known: Any, stop: Any = None) -> None:
        try:
            data = self.read(key)
        except objects.RemoteError:
            data = b""
        files.write_bytes(path, data)

    objects.Remote.get = get  # type: ignore[method-assign]
    pull.verify_trial = lambda folder: []  # type: ignore[attr-defined]


# -- clocks --------------------------------------------------------------------------------------


@plant
def clock_gate_open() -> None:
    """The gate of the clocks accepts everything."""
    found = quality.sync_gate
    quality.sync_gate = lambda *given: found(*given).model_copy(update={"passed": True})  # type: ignore[assignment]


# -- rig and watches -----------------------------------------------------------------------------


@plant
def stop_unheard() -> None:
    """A stop whose exception was lost is not looked for while the arm moves."""
    rig.Rig.should_stop = property(lambda self: lambda: False, nothing)  # type: ignore[assignment]


@plant
def retracts_always() -> None:
    """An arm in a protective stop is sent clear of the plate."""
    ArmState.healthy = property(lambda self: True)  # type: ignore[assignment,method-assign]


# -- a second set: defects that came to mind after the storm was written ---------------------------


@plant
def skin_once() -> None:
    """A skin that is logged during a night counts from the next one on."""
    made = session.LoggedContext

    class Once(made):  # type: ignore[misc,valid-type]
        def read(self) -> dict[str, str]:
            if not hasattr(self, "_once"):
                self._once = super().read()
            return dict(self._once)

    session.LoggedContext = Once  # type: ignore[misc]


@plant
def retakes_forgotten() -> None:
    """Failed attempts of earlier sessions do not count."""
    store.Campaign.failed_attempts = lambda self: {}  # type: ignore[method-assign]


@plant
def nan_passes() -> None:
    """A pose that is no number is taken for one inside the limits."""
    watch = guard.Guard.check_measured

    def watching(self: guard.Guard, pose: Any, *given: Any, **named: Any) -> None:
        if pose.xyz_mm[2] == pose.xyz_mm[2]:
            watch(self, pose, *given, **named)

    guard.Guard.check_measured = watching  # type: ignore[method-assign]
    rig.check_pose = lambda pose: pose  # type: ignore[attr-defined]


@plant
def stall_unseen() -> None:
    """An arm whose pose does not change any more is not stopped."""
    motion_watch.STUCK_S = 1e9  # type: ignore[misc]


@plant
def silence_passes() -> None:
    """A force sensor with a limit may be silent."""
    force_watch.SILENT_S = 1e9  # type: ignore[misc]


@plant
def interval_third() -> None:
    """The stated uncertainty of a clock is a third of what it is: too little for one trial."""
    made = synchronise.DeviceSync.record
    synchronise.DeviceSync.record = lambda self: made(  # type: ignore[method-assign]
        replace(self, uncertainty_ns=self.uncertainty_ns / 3)
    )


@plant
def remote_trusted() -> None:
    """What is at the URL is taken for what was sent, by its size."""
    objects.Remote.matches = lambda self, key, known, *more: self.size(key) == known.bytes  # type: ignore[method-assign]


@plant
def hold_short() -> None:
    """A wait ends after nine tenths of its time."""
    wait = rig.Rig.wait
    rig.Rig.wait = lambda self, seconds, sink=None: wait(self, 0.9 * seconds, sink)  # type: ignore[method-assign]


@plant
def run_lost() -> None:
    """A run whose begin the page took, and answered too late, stays pending."""
    begin = runs.ServedRuns._begin

    async def forgetting(self: runs.ServedRuns, client: Any, run: Any) -> None:
        try:
            await begin(self, client, run)
        finally:
            self._asked = None

    runs.ServedRuns._begin = forgetting  # type: ignore[method-assign]


# -- a third set, of kinds that the two before do not have -----------------------------------------


@plant
def reach_unwatched() -> None:
    """Places are held against the depth alone, on the plan and on the way."""
    places = guard.Guard._places

    def deep(self: guard.Guard, *given: Any) -> Any:
        return (each for each in places(self, *given) if each.error is guard.DepthError)

    guard.Guard._places = deep  # type: ignore[method-assign]


@plant
def zero_of_skin() -> None:
    """Depth zero of the skin before is believed after another was logged."""
    fresh = session.TrialCollector.fresh_start
    was_paused = supervisor.CollectionSupervisor.was_paused
    paused = [False]

    def was(self: supervisor.CollectionSupervisor) -> bool:
        paused[0] = was_paused(self)
        return paused[0]

    def only_paused(self: session.TrialCollector) -> None:
        if paused[0]:
            fresh(self)

    supervisor.CollectionSupervisor.was_paused = was  # type: ignore[method-assign]
    session.TrialCollector.fresh_start = only_paused  # type: ignore[method-assign]


@plant
def tail_lost() -> None:
    """What devices still hold when their streams stop is not read."""
    stop = rig.Rig.stop_streams

    rig.Rig.stop_streams = lambda self, sink: stop(self, NullSink())  # type: ignore[method-assign]


@plant
def free_once() -> None:
    """The room on the disk is read before the first trial, and believed from then on."""
    made = watches.DiskWatch.__init__

    def once(self: watches.DiskWatch, *given: Any, **named: Any) -> None:
        made(self, *given, **named)
        free, known = self._free, list[int]()

        def first(folder: Path) -> int:
            if not known:
                known.append(free(folder))
            return known[0]

        self._free = first

    watches.DiskWatch.__init__ = once  # type: ignore[method-assign]


@plant
def end_guessed() -> None:
    """A run that was to be cancelled is closed as cancelled, however it ended."""
    close = runs.ServedRuns._close

    async def guessing(self: runs.ServedRuns, client: Any, *, cancelled: bool) -> None:
        end_of = runs.run_records.end_of
        if cancelled:
            runs.run_records.end_of = lambda *given: None  # type: ignore[assignment]
        try:
            await close(self, client, cancelled=cancelled)
        finally:
            runs.run_records.end_of = end_of

    runs.ServedRuns._close = guessing  # type: ignore[method-assign]


# -- a fourth set: what gates, limits, references, forgiveness and the server do -------------------


@plant
def force_normal_only() -> None:
    """A force beyond the limit stops the arm only where it presses on the plate."""
    check = force_watch.ForceWatch._check_limit
    force_watch.ForceWatch._check_limit = lambda self, forces: check(self, forces * [0, 0, 1])  # type: ignore[method-assign]


@plant
def path_unjudged() -> None:
    """The gate of the path takes every path for a straight one."""
    quality.path_deviation_mm = lambda *given: 0.0


@plant
def retracts_home() -> None:
    """After a failure the arm leaves towards the plate's centre, and not straight out."""
    made = rig.Position
    retract = rig.Rig._retract

    def homewards(self: rig.Rig, clear: Any, error: BaseException) -> Any:
        rig.Position = lambda x, y, depth: made(clear.x_mm, clear.y_mm, depth)  # type: ignore[attr-defined]
        try:
            return retract(self, clear, error)
        finally:
            rig.Position = made  # type: ignore[attr-defined]

    rig.Rig._retract = homewards  # type: ignore[method-assign]


@plant
def seed_of_first() -> None:
    """Every attempt at a trial has the seed of the first one."""
    hashed = session.hash_integer

    def first(seed: int, *of: Any) -> int:
        return hashed(seed, 0) if len(of) == 1 else hashed(seed, *of)

    session.hash_integer = first  # type: ignore[attr-defined]


@plant
def reference_previous() -> None:
    """A reference trial is compared with the one before it, so that a slow drift passes."""
    look = watches.ReferenceWatch.look

    def looking(self: watches.ReferenceWatch, trial: Any) -> None:
        look(self, trial)
        if self._first is not None and trial.role == "reference":
            assert self._gate is not None
            recording = self._campaign.recording(trial.id)
            self._first = trial.id, references.reference_figures(recording, self._gate)

    watches.ReferenceWatch.look = looking  # type: ignore[method-assign]


@plant
def status_by_name() -> None:
    """A trial that the status has seen counts from then on, whatever happens to its folder."""
    folders, known = status.StatusReader._folders, dict[str, Any]()

    def seen(self: status.StatusReader, campaign: store.Campaign) -> Any:
        known.update(folders(self, campaign))
        there = {path.name for path in campaign.folders("trials")}
        return {name: each for name, each in known.items() if name in there}

    status.StatusReader._folders = seen  # type: ignore[method-assign]


@plant
def never_kills() -> None:
    """A run that does not stop gets its time to do so anew at each look."""
    terminate = runs.ServedRuns._terminate

    def patient(self: runs.ServedRuns) -> None:
        terminate(self)
        self._stop_by = runs.monotonic() + runs.STOP_LIMIT_S  # type: ignore[attr-defined]

    runs.ServedRuns._terminate = patient  # type: ignore[method-assign]


# -- a fifth set: bounds, tails, tellings and requests ---------------------------------------------


@plant
def box_exact() -> None:
    """What is known by the host's clock only is as exact as if the box's were known exactly."""
    made = synchronise._through_host

    def exact(bounded: Any, *given: Any) -> Any:
        return replace(made(bounded, *given), uncertainty_ns=bounded.uncertainty_ns)

    synchronise._through_host = exact


@plant
def arrival_undelayed() -> None:
    """A message is thought to be sent when it arrives."""
    made = synchronise._by_arrival
    no_delay = {"shortest_us": 0, "longest_us": 0}
    synchronise._by_arrival = lambda delay, *given: made(delay.model_copy(update=no_delay), *given)


@plant
def record_tail() -> None:
    """What was pushed last before a recording's trial ends is not written."""
    drain = recorder.RecordedTrial._drain

    def draining(self: Any, writer: Any, begun: Any, last: bool = False) -> None:
        if not last:
            drain(self, writer, begun)

    recorder.RecordedTrial._drain = draining  # type: ignore[method-assign]


@plant
def told_again() -> None:
    """Who was told of an event is not on the disk, so that another program tells it again."""
    outbox.write_json = nothing  # type: ignore[attr-defined]


@plant
def again_skipped() -> None:
    """A trial that was skipped and is wanted after all stays skipped."""
    again = control.again

    def staying(campaign: store.Campaign, trials: Any, by: Any) -> dict[str, str]:
        known = control.skipped(campaign)
        did = again(campaign, trials, by)
        if known:
            control.write_json(campaign.folder / control.SKIPPED, known)
        return did

    requests.control.again = staying  # type: ignore[attr-defined]


@plant
def more_forgotten() -> None:
    """A trial that is wanted again in a night is left to the next one."""
    supervisor.CollectionSupervisor.more = lambda self: []  # type: ignore[method-assign]


@plant
def left_writable() -> None:
    """The files of a committed trial are not protected from being written to."""
    writer.protect = nothing  # type: ignore[attr-defined]


@plant
def measured_wide() -> None:
    """A pose on the way may be three millimetres beyond the limits."""
    guard.MEASURED_MM = 3.0  # type: ignore[misc]


# -- a sixth set: what is stored, and what gates look at -------------------------------------------


@plant
def polarity_flipped() -> None:
    """Events are stored with the other polarity."""
    add = hdf5_writer.StreamFile.add

    def flipping(self: hdf5_writer.StreamFile, device: str, chunk: Any) -> None:
        events = isinstance(chunk, EventChunk)
        add(self, device, replace(chunk, p=1 - chunk.p) if events else chunk)

    hdf5_writer.StreamFile.add = flipping  # type: ignore[method-assign]


@plant
def burst_unjudged() -> None:
    """The gate of bursts of events looks at none."""
    quality._event_burst = lambda event_us: 0


@plant
def reserve_used() -> None:
    """A trial may use what is to stay free on the disk."""
    watches.RESERVE = 0  # type: ignore[attr-defined]
