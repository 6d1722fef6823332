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
from tests.patching import put

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
        put(module, "make_visible", lambda folder, target: os.rename(folder, target))


@plant
def data_unflushed() -> None:
    """A trial's data are not flushed before its record is written."""
    put(writer, "sync_file", nothing)


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

    put(store.Campaign, "quarantine", deleting)


@plant
def journal_reuses() -> None:
    """The number of a request that comes second replaces the first one's file."""

    def add(self: journal.Journal, number: int, data: Any) -> bool:
        files.make_folder(self.folder)
        files.write_json(self.path(max(number - 1, 1)), data)
        return True

    put(journal.Journal, "add", add)


@plant
def left_open() -> None:
    """A handle of the trials' folder stays open after each commit."""
    sync_folder = writer.sync_folder

    def leaking(folder: Path) -> None:
        os.open(folder, os.O_RDONLY)
        sync_folder(folder)

    put(writer, "sync_folder", leaking)


@plant
def manifest_first() -> None:
    """The manifest of a trial is pushed before its files."""
    send = pushing._Push._send

    def early(self: Any, made: Any, folder: Path, existing: Any) -> bool:
        self.remote.put(made.key, made.dump())
        return send(self, made, folder, existing)

    put(pushing._Push, "_send", early)


@plant
def pull_unchecked() -> None:
    """What is pulled becomes visible although files of it are missing."""

    def get(self: objects.Remote, key: str, path: Path, known: Any, stop: Any = None) -> None:
        try:
            data = self.read(key)
        except objects.RemoteError:
            data = b""
        files.write_bytes(path, data)

    put(objects.Remote, "get", get)
    put(pull, "verify_trial", lambda folder: [])


# -- clocks --------------------------------------------------------------------------------------


@plant
def clock_gate_open() -> None:
    """The gate of the clocks accepts everything."""
    found = quality.sync_gate
    put(quality, "sync_gate", lambda *given: found(*given).model_copy(update={"passed": True}))


# -- rig and watches -----------------------------------------------------------------------------


@plant
def stop_unheard() -> None:
    """A stop whose exception was lost is not looked for while the arm moves."""
    put(rig.Rig, "should_stop", property(lambda self: lambda: False, nothing))


@plant
def retracts_always() -> None:
    """An arm in a protective stop is sent clear of the plate."""
    put(ArmState, "healthy", property(lambda self: True))


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

    put(session, "LoggedContext", Once)


@plant
def retakes_forgotten() -> None:
    """Failed attempts of earlier sessions do not count."""
    put(store.Campaign, "failed_attempts", lambda self: {})


@plant
def nan_passes() -> None:
    """A pose that is no number is taken for one inside the limits."""
    watch = guard.Guard.check_measured

    def watching(self: guard.Guard, pose: Any, *given: Any, **named: Any) -> None:
        if pose.xyz_mm[2] == pose.xyz_mm[2]:
            watch(self, pose, *given, **named)

    put(guard.Guard, "check_measured", watching)
    put(rig, "check_pose", lambda pose: pose)


@plant
def stall_unseen() -> None:
    """An arm whose pose does not change any more is not stopped."""
    put(motion_watch, "STUCK_S", 1e9)


@plant
def silence_passes() -> None:
    """A force sensor with a limit may be silent."""
    put(force_watch, "SILENT_S", 1e9)


@plant
def interval_third() -> None:
    """The stated uncertainty of a clock is a third of what it is: too little for one trial."""
    made = synchronise.DeviceSync.record
    put(
        synchronise.DeviceSync,
        "record",
        lambda self: made(replace(self, uncertainty_ns=self.uncertainty_ns / 3)),
    )


@plant
def remote_trusted() -> None:
    """What is at the URL is taken for what was sent, by its size."""
    put(objects.Remote, "matches", lambda self, key, known, *more: self.size(key) == known.bytes)


@plant
def hold_short() -> None:
    """A wait ends after nine tenths of its time."""
    wait = rig.Rig.wait
    put(rig.Rig, "wait", lambda self, seconds, sink=None: wait(self, 0.9 * seconds, sink))


@plant
def run_lost() -> None:
    """A run whose begin the page took, and answered too late, stays pending."""
    begin = runs.ServedRuns._begin

    async def forgetting(self: runs.ServedRuns, client: Any, run: Any) -> None:
        try:
            await begin(self, client, run)
        finally:
            self._asked = None

    put(runs.ServedRuns, "_begin", forgetting)


# -- a third set, of kinds that the two before do not have -----------------------------------------


@plant
def reach_unwatched() -> None:
    """Places are held against the depth alone, on the plan and on the way."""
    places = guard.Guard._places

    def deep(self: guard.Guard, *given: Any) -> Any:
        return (each for each in places(self, *given) if each.error is guard.DepthError)

    put(guard.Guard, "_places", deep)


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

    put(supervisor.CollectionSupervisor, "was_paused", was)
    put(session.TrialCollector, "fresh_start", only_paused)


@plant
def tail_lost() -> None:
    """What devices still hold when their streams stop is not read."""
    stop = rig.Rig.stop_streams

    put(rig.Rig, "stop_streams", lambda self, sink: stop(self, NullSink()))


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

    put(watches.DiskWatch, "__init__", once)


@plant
def end_guessed() -> None:
    """A run that was to be cancelled is closed as cancelled, however it ended."""
    close = runs.ServedRuns._close

    async def guessing(self: runs.ServedRuns, client: Any, *, cancelled: bool) -> None:
        end_of = runs.run_records.end_of
        if cancelled:
            put(runs.run_records, "end_of", lambda *given: None)
        try:
            await close(self, client, cancelled=cancelled)
        finally:
            runs.run_records.end_of = end_of

    put(runs.ServedRuns, "_close", guessing)


# -- a fourth set: what gates, limits, references, forgiveness and the server do -------------------


@plant
def force_normal_only() -> None:
    """A force beyond the limit stops the arm only where it presses on the plate."""
    check = force_watch.ForceWatch._check_limit
    put(
        force_watch.ForceWatch, "_check_limit", lambda self, forces: check(self, forces * [0, 0, 1])
    )


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
        put(rig, "Position", lambda x, y, depth: made(clear.x_mm, clear.y_mm, depth))
        try:
            return retract(self, clear, error)
        finally:
            put(rig, "Position", made)

    put(rig.Rig, "_retract", homewards)


@plant
def seed_of_first() -> None:
    """Every attempt at a trial has the seed of the first one."""
    hashed = session.hash_integer

    def first(seed: int, *of: Any) -> int:
        return hashed(seed, 0) if len(of) == 1 else hashed(seed, *of)

    put(session, "hash_integer", first)


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

    put(watches.ReferenceWatch, "look", looking)


@plant
def status_by_name() -> None:
    """A trial that the status has seen counts from then on, whatever happens to its folder."""
    folders, known = status.StatusReader._folders, dict[str, Any]()

    def seen(self: status.StatusReader, campaign: store.Campaign) -> Any:
        known.update(folders(self, campaign))
        there = {path.name for path in campaign.folders("trials")}
        return {name: each for name, each in known.items() if name in there}

    put(status.StatusReader, "_folders", seen)


@plant
def never_kills() -> None:
    """A run that does not stop gets its time to do so anew at each look."""
    terminate = runs.ServedRuns._terminate

    def patient(self: runs.ServedRuns) -> None:
        terminate(self)
        put(self, "_stop_by", runs.monotonic() + runs.STOP_LIMIT_S)

    put(runs.ServedRuns, "_terminate", patient)


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

    put(recorder.RecordedTrial, "_drain", draining)


@plant
def told_again() -> None:
    """Who was told of an event is not on the disk, so that another program tells it again."""
    put(outbox, "write_json", nothing)


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

    put(requests.control, "again", staying)


@plant
def more_forgotten() -> None:
    """A trial that is wanted again in a night is left to the next one."""
    put(supervisor.CollectionSupervisor, "more", lambda self: [])


@plant
def left_writable() -> None:
    """The files of a committed trial are not protected from being written to."""
    put(writer, "protect", nothing)


@plant
def measured_wide() -> None:
    """A pose on the way may be three millimetres beyond the limits."""
    put(guard, "MEASURED_MM", 3.0)


# -- a sixth set: what is stored, and what gates look at -------------------------------------------


@plant
def polarity_flipped() -> None:
    """Events are stored with the other polarity."""
    add = hdf5_writer.StreamFile.add

    def flipping(self: hdf5_writer.StreamFile, device: str, chunk: Any) -> None:
        events = isinstance(chunk, EventChunk)
        add(self, device, replace(chunk, p=1 - chunk.p) if events else chunk)

    put(hdf5_writer.StreamFile, "add", flipping)


@plant
def burst_unjudged() -> None:
    """The gate of bursts of events looks at none."""
    quality._event_burst = lambda event_us: 0


@plant
def reserve_used() -> None:
    """A trial may use what is to stay free on the disk."""
    put(watches, "RESERVE", 0)
