"""What must be true of a store, by a record that is kept outside it."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from sliplab.analysis.quality import gated_as
from sliplab.flows.log import log_entries
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.status import StatusReader
from sliplab.storage.errors import StoreError
from sliplab.storage.files import is_temporary, read_json
from sliplab.storage.schema.trial import TrialRecord
from sliplab.storage.trials import control
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import FORGIVEN, Campaign, TrialStore
from sliplab.storage.trials.verify import content_problems, verify_trial
from tests.storm.sent import differences, most_events
from tests.storm.steps import NAME

LATER = {"cause.json"}
"""Files of an attempt in quarantine that a request may change."""
DEVICES = {"events": "event_camera", "frames": "frame_camera", "arm": "arm"}
GAP_S = 0.1
"""How long an event camera may see nothing in a slide."""
STRAY_MM = 0.1
"""How far poses may lie from their path for noise."""
TIMES = {"95 %": 3.0}
"""Times its stated uncertainty up to which a clock's error is accepted, by what that states."""

Sums = dict[str, str]


class Wrong(Exception):
    """An invariant does not hold.

    Attributes:
        invariant: its name. what: how it was broken.
    """

    def __init__(self, invariant: str, what: str) -> None:
        super().__init__(f"{invariant}: {what}")
        self.invariant, self.what = invariant, what


class Ledger:
    """The trials, requests and notes that a store has to keep.

    Args:
        folder: of the store.
        request: whose plan is collected.
    """

    def __init__(self, folder: Path, request: RunRequest) -> None:
        self._folder, self._campaign = folder, folder / "campaigns" / NAME
        self._plan = {trial.id: trial for trial in request.plan}
        self._describe = request.plan.describe
        self._retakes = request.plan.protocol.collection.gates.retakes
        self._gates = request.plan.protocol.collection.gates
        gate = self._gates.reference
        self._devices = ["arm", *request.rig.cameras]
        self._drift_percent = None if gate is None else float(gate.event_rate)
        self._rates: dict[str, float] = {}
        self._skin = request.rig.skin.serial
        self._skins: dict[str, str] = {}
        self._logs: dict[str, Any] | None = None
        self._sent: dict[str, dict[str, Any]] = {}
        self.takes: dict[str, list[Sums]] = {}
        self._pulled: dict[str, Sums] = {}
        self.spoilt: set[str] = set()
        self.errors: list[tuple[str, float]] = []
        self.trials: dict[str, Sums] = {}
        self.aside: dict[str, Sums] = {}
        self.others: dict[str, Sums] = {}
        self.files: Sums = {}
        self._ended = True
        self.damaged: dict[str, tuple[str, Sums]] = {}
        self._moving: set[str] = set()
        self._begun: set[str] = set()
        self._waiting = False
        self.owed: set[str] = set()
        self.unfinished: dict[str, Sums] = {}
        self.counts: Counter[str] = Counter()
        self.again: Counter[str] = Counter()
        self.failed: Counter[str] = Counter()
        self.logged: dict[str, float] = {}
        self.asked: dict[int, str] = {}
        self._known: dict[tuple[Any, ...], str] = {}
        self._status: StatusReader | None = None

    def look(self, notes: list[dict[str, Any]], ended: bool, calm: bool) -> None:
        """Hold the store against the record after a step, and record what is new.

        Args:
            notes: of the step's process.
            ended: it ended by itself, and not in a kill or a power cut.
            calm: nothing disturbed the rig.

        Raises:
            Wrong: an invariant does not hold.
        """
        self._read(notes)
        self._ended = ended
        if not (self._folder / "store.json").exists():
            if self.trials or self.files:
                raise Wrong("nothing committed is lost", "the store is gone")
            return
        try:
            aside = self._folders("quarantine")
            before = {*self.trials}
            self._check_aside(aside, calm)
            self._check_trials(aside)
            self._check_references(before, notes)
            self._check_recorded(notes, ended)
            self._check_others(notes)
            self._check_copies(notes)
            self._check_journals()
            self._check_status()
        except (OSError, ValueError, KeyError, StoreError) as error:
            what = repr(error).replace(str(self._folder), "")
            raise Wrong("what is kept can be read", what) from error

    def _read(self, notes: list[dict[str, Any]]) -> None:
        for note in notes:
            if "wrong" in note:
                raise Wrong(note["wrong"], note["what"])
            if note.get("asked") == "again" or note.get("asks") == "again":
                self.again.update(note["trials"])
            if "asks" in note:
                self._begun.add(note["asks"])
            if "damaged" in note:
                before, _ = self.damaged.get(note["damaged"], ("", {}))
                self.damaged[note["damaged"]] = "cut" if before == "cut" else note["how"], {}
            if "spoilt" in note:
                self.spoilt.add(note["spoilt"])
            if "begins" in note:
                self._skins[note["begins"]] = self._skin
            if "recorded" in note:
                self._sent[note["recorded"]] = note
            if "logs" in note:
                self._logs = note
            if "logged" in note:
                self._take_log(note["logged"], note)
            if "number" in note:
                self.asked[note["number"]] = note["asked"]

    def _take_log(self, text: str, note: dict[str, Any]) -> None:
        self.logged[text] = note["at_s"]
        self._skin = note.get("skin", self._skin)
        self._logs = None

    # -- trials ----------------------------------------------------------------------------

    def _sums(self, folder: Path) -> Sums:
        files = (path for path in sorted(folder.iterdir()) if not is_temporary(path.name))
        return {path.name: self._sum(path) for path in files}

    def _sum(self, path: Path) -> str:
        about = path.stat()
        key = (path.name, about.st_ino, about.st_size, about.st_mtime_ns, about.st_ctime_ns)
        if key not in self._known:
            self._known[key] = hashlib.sha256(path.read_bytes()).hexdigest()
        return self._known[key]

    def _folders(self, name: str) -> dict[str, Sums]:
        folder = self._campaign / name
        there = sorted(folder.iterdir()) if folder.is_dir() else []
        return {path.name: self._sums(path) for path in there}

    def _check_aside(self, aside: dict[str, Sums], calm: bool) -> None:
        for name, sums in self.aside.items():
            if _without(aside.get(name, {})) != _without(sums):
                raise Wrong("nothing complete is thrown away", f"quarantine/{name} changed or went")
        for name in aside.keys() - self.aside.keys():
            path = self._campaign / "quarantine" / name / "cause.json"
            cause = str(read_json(path).get("cause") or "") if path.exists() else ""
            if not cause:
                raise Wrong("a log is true", f"quarantine/{name} has no cause")
            if cause.startswith("gate") and calm and name.rpartition(".")[0] not in self.unfinished:
                gates = TrialRecord.load(path.with_name("record.json")).quality.gates
                # limits of the clocks are close: chance alone is beyond them now and then, or
                # leaves a short trial without a clock, so that nothing is known of its gaps
                odd = [n for n, g in gates.items() if not g.passed and not n.startswith("sync_")]
                if odd and not any(isinstance(g.value, str) for g in gates.values()):
                    raise Wrong("what is in order passes its gates", f"{name}: {odd}")
        self.aside = aside

    def _check_trials(self, aside: dict[str, Sums]) -> None:
        now = self._folders("trials")
        moving = {name for name, sums in now.items() if "cause.json" in sums}
        for name, sums in self.trials.items():
            if now.get(name) == sums or (name in moving and _without(now[name]) == sums):
                continue
            kept = any(
                _without(other) == sums for key, other in aside.items() if key.startswith(name)
            )
            if name in self.damaged:
                continue
            if not kept:
                raise Wrong("nothing committed is lost or changed", name)
            if not self.again[name]:
                raise Wrong("nothing committed is lost or changed", f"{name}: no request for it")
        for name in sorted(now.keys() - moving):
            if self.trials.get(name) == now[name]:
                if name in self.damaged:  # once more, which has changed nothing
                    self.damaged[name] = self.damaged[name][0], now[name]
                continue
            if name in self.damaged:
                how, sums = self.damaged.pop(name)
                if sums in ({}, now[name]):
                    self.damaged[name] = how, now[name]
                    continue
            self._check_new(name, aside)
            self.takes.setdefault(name, []).append(now[name])
        self.trials = {name: now[name] for name in now.keys() - moving}
        self._moving = moving
        self.damaged = {name: how for name, how in self.damaged.items() if name in self.trials}

    def _check_new(self, name: str, aside: dict[str, Sums]) -> None:
        folder = self._campaign / "trials" / name
        for problem in verify_trial(folder):
            raise Wrong("what is committed is whole", f"{name}: {problem.what}")
        for text in differences(folder, self._sent[name]["sent"]):
            raise Wrong("what was sent is stored", f"{name}: {text}")
        for path in folder.iterdir() if self._ended else ():  # a disk that lost power has no modes
            if path.stat().st_mode & 0o222:
                raise Wrong("what is committed is protected", f"{name}/{path.name}")
        recording = Recording(folder)
        record = recording.record
        trial = self._plan[name]
        self._check_record(name, record, read_json(folder / PROVENANCE))
        self._sent[name]["gap_s"] = 0.0
        if "events" in self._devices:
            start_us, end_us = recording.step("hold")
            self._rates[name] = len(recording.events(start_us, end_us)) / (end_us - start_us)
            events = recording.events(*recording.step("slide")).t_us
            self._sent[name]["gap_s"] = float(np.diff(events).max(initial=0)) / 1e6
        states = record.trial, record.seed, json.dumps(record.condition, default=str)
        if states != (name, trial.seed, json.dumps(self._describe(trial), default=str)):
            raise Wrong("a record is true", f"{name}: states {states}")
        attempts = [each for each in self._causes(name) if each.startswith(("gate", "again"))]
        if record.attempt != len(attempts):
            what = f"{name}: is attempt {record.attempt} after {len(attempts)}"
            raise Wrong("a record is true", what)
        for item in Campaign(self._campaign).quarantined():
            mine = item["trial"] == name and str(item["cause"]).startswith(("gate", "again"))
            if mine and aside[item["folder"]].get("data.h5") == self._sum(folder / "data.h5"):
                what = f"{name} and quarantine/{item['folder']} have the same data"
                raise Wrong("each attempt has its own seed", what)
        skin = read_json(folder / PROVENANCE).get("skin")
        if skin != self._skins[name]:
            raise Wrong("a record is true", f"{name}: skin {skin}, {self._skins[name]} was logged")
        if not record.simulated or not Campaign(self._campaign).info["simulated"]:
            raise Wrong("nothing simulated is unmarked", name)
        self._check_gates(name, record, folder)
        truth = (record.simulation_truth or {}).get("clocks", {})
        for device, clock in record.clocks.devices().items():
            pairs = np.array(truth.get(DEVICES.get(device, device), ()))
            if clock.grade == "host arrival":
                pairs = np.array(self._sent[name]["arrived"] if device == "frames" else ())
            if clock.first_ns is not None and len(pairs):  # beyond its pulses nothing is stated
                between = (pairs[:, 0] >= clock.first_ns) & (pairs[:, 0] <= clock.last_ns)
                pairs = pairs[between]
            if not len(pairs) or clock.uncertainty_ns is None:
                continue
            error = np.abs(np.asarray(clock.map.to_reference(pairs[:, 0])) - pairs[:, 1]).max()
            if clock.kind == "95 %":
                self.errors.append((device, float(error / clock.uncertainty_ns)))
            if error > TIMES.get(clock.kind or "", 1.0) * clock.uncertainty_ns + 1:
                what = f"{name}: {device} is {error:.0f} ns off, stated {clock.uncertainty_ns:.0f}"
                raise Wrong("no time is wrong beyond its interval", what)

    def _check_record(self, name: str, record: TrialRecord, provenance: dict[str, Any]) -> None:
        """Hold what a record states against what the witness saw."""
        seen, trial = self._sent[name], self._plan[name]
        rows = {column: count for column, (count, _) in seen["sent"].items()}
        counted = record.counts
        for key, true_s in zip(("started", "ended"), seen["times"], strict=True):
            if not abs(datetime.fromisoformat(provenance[key]).timestamp() - true_s) < 0.01:
                raise Wrong("a record is true", f"{name}: {key} {provenance[key]}, not {true_s}")
        for key, states, true in (
            ("counts.events", counted.events, rows.get("events/t", 0)),
            ("counts.frames", counted.frames, rows.get("frames/t", 0)),
            ("counts.poses", counted.poses, rows.get("poses/t", 0)),
            ("counts.pulses", counted.pulses, rows.get("sync_pulses/t", 0)),
            ("depth_zero_mm", record.depth_zero_mm, seen["zero_mm"]),
            ("steps", [[step.phase, step.recorded] for step in record.steps], seen["phases"]),
            ("role", record.role, trial.role),
            ("block", record.block, trial.block),
            ("repetition", record.repetition, trial.repetition),
        ):
            if states != true:
                raise Wrong("a record is true", f"{name}: {key} = {states}, not {true}")

    def _check_gates(self, name: str, record: TrialRecord, folder: Path) -> None:
        """Every gate of the protocol was applied, with its limit, to what was recorded."""
        gates, seen, asked = record.quality.gates, self._sent[name], self._gates
        limits: dict[str, Any] = {
            "path_deviation_mm": asked.path_deviation,
            "speed_deviation_percent": asked.speed_deviation,
        }
        if "frames" in self._devices:
            limits["frames_lost"] = asked.frames_lost
        if "events" in self._devices:
            limits |= {"event_gap_s": asked.event_gap, "event_burst": asked.event_burst}
        clocks = (f"sync_uncertainty_{device}_s" for device in self._devices)
        for gate in {*limits, *clocks, "sync_unvouched_s"} - {*gates}:
            raise Wrong("what is committed passed its gates", f"{name}: {gate} was not applied")
        for gate, found in gates.items():
            value, limit = float(found.value or 0), float(found.limit or 0)
            if gate.startswith("sync_uncertainty"):
                sync = asked.sync_uncertainty
                timing = record.timing.rig if record.timing else None
                assert timing is not None
                assert found.grade is not None
                limits[gate] = sync.limit_s(gated_as(found.grade, timing))
                known = record.clocks.devices()
                device = gate.removeprefix("sync_uncertainty_").removesuffix("_s")
                both = {device, "events"} & {*known}
                true = sum(float(known[each].uncertainty_ns or 0) for each in both) / 1e9
                if not abs(value - true) <= 1e-6 * true:
                    what = f"{name}: {gate} = {value}, its clocks state {true}"
                    raise Wrong("a gate sees what was recorded", what)
            if not (found.passed and 0 <= value <= limit == float(limits.get(gate, limit))):
                what = f"{name}: {gate} = {value}, limit {limit}, asked {limits.get(gate)}"
                raise Wrong("what is committed passed its gates", what)
        burst = gates.get("event_burst")
        if burst is not None and burst.value != (most := most_events(folder)):
            what = f"{name}: event_burst = {burst.value}, there are {most}"
            raise Wrong("a gate sees what was recorded", what)
        for key, value, limit in (
            ("strayed_mm", seen["strayed_mm"], 1.2 * float(asked.path_deviation) + STRAY_MM),
            ("lost", seen["lost"], asked.frames_lost),
            ("gap_s", seen["gap_s"], float(asked.event_gap) + GAP_S),
        ):
            if not value <= limit:
                raise Wrong("a gate sees what was recorded", f"{name}: {key} = {value}")

    def _check_references(self, before: set[str], notes: list[dict[str, Any]]) -> None:
        """Nothing is taken after a reference trial that has drifted.

        Args:
            before: trials that were committed before this step.
        """
        if self._drift_percent is None or any("again" in note.values() for note in notes):
            return
        references = [name for name, each in self._plan.items() if each.role == "reference"]
        known = [name for name in references if name in before]
        if not {*known} <= self.trials.keys():
            return
        for note in notes:
            name = note.get("trial", "")
            if note.get("outcome") == "committed" and name in references:
                known.append(name)
            skin = self._skins.get(known[-1]) if known else None
            alike = [each for each in known if self._skins[each] == skin]
            drifted = ""
            if len(alike) > 1:
                first, last = self._rates[alike[0]], self._rates[alike[-1]]
                far = 100 * abs(last / first - 1) > 1.2 * self._drift_percent
                drifted = alike[-1] if far else ""
            if drifted and "begins" in note and skin == self._skin:
                raise Wrong("a drifted reference ends the night", f"{note['begins']} after it")

    def _check_recorded(self, notes: list[dict[str, Any]], ended: bool) -> None:
        """What was recorded completely is kept; what was not finished is at least set aside."""
        # what is on its way to quarantine when the power is cut is still among the trials
        aside = (name.rpartition(".")[0] for name in self.aside)
        kept = {*self.trials, *self._moving, *aside}
        folder = self._campaign / "incoming"
        incoming = {path.name for path in folder.iterdir()} if folder.is_dir() else set()
        for name, sums in self.unfinished.items():
            new = self._causes(name)[self.counts[name] :]
            # it may be taken again at once, which in a simulation gives the same data
            if name in self.owed and any(not each.startswith(("gate", "again")) for each in new):
                raise Wrong("nothing complete is thrown away", f"{name} had its record")
            if name not in incoming and not self._recovered(name, sums) and not new:
                raise Wrong("nothing complete is thrown away", f"incoming/{name} is gone")
        self.unfinished = {name: self._sums(folder / name) for name in incoming}
        self.counts = Counter(name.rpartition(".")[0] for name in self.aside)
        self.owed = {name for name in incoming - {*self.trials} if _is_complete(folder / name)}
        forgiven = self._waiting or any("again" in note.values() for note in notes)
        places = [note["place"] for note in notes if "begins" in note]
        if places != sorted(places) and not forgiven:
            raise Wrong("trials are taken in the plan's order", f"{places}")
        for note in notes:
            count = self.failed[note.get("begins", "")]
            if count > self._retakes and not forgiven:
                what = f"{note['begins']} begins again, it failed {count} times"
                raise Wrong("a failed trial is retaken as often as planned", what)
        failed = self.failed = Counter(
            item["trial"]
            for item in Campaign(self._campaign).quarantined()
            if str(item["cause"]).startswith("gate") and FORGIVEN not in item
        )
        for name, count in failed.items():
            if count > self._retakes + 1:
                what = f"{name} failed {count} times, {self._retakes} retakes are allowed"
                raise Wrong("a failed trial is retaken as often as planned", what)
        for note in notes:
            if note.get("outcome") == "committed" and note["trial"] not in kept:
                raise Wrong("nothing committed is lost or changed", f"{note['trial']} was reported")
            if ended and "recorded" in note and note["recorded"] not in kept | incoming:
                raise Wrong("nothing complete is thrown away", f"{note['recorded']} was recorded")

    def _recovered(self, name: str, sums: Sums) -> bool:
        """Return whether a trial was committed with the data that it had unfinished."""
        return "data.h5" in sums and self.trials.get(name, {}).get("data.h5") == sums["data.h5"]

    def _check_others(self, notes: list[dict[str, Any]]) -> None:
        """Trials of other campaigns: imported, or recorded without a protocol."""
        now: dict[str, Sums] = {}
        for path in sorted(self._folder.glob("campaigns/*/trials/*")):
            if (campaign := path.parent.parent.name) != NAME:
                now[f"{campaign}/{path.name}"] = self._sums(path)
        reported = {note["kept"]: note for note in notes if "kept" in note}
        for name in self.others.keys() | reported.keys():
            if name not in now or self.others.get(name, now[name]) != now[name]:
                raise Wrong("nothing committed is lost or changed", name)
        for name in now.keys() - self.others.keys():
            campaign, _, trial = name.partition("/")
            folder = self._folder / "campaigns" / campaign / "trials" / trial
            for problem in verify_trial(folder):
                raise Wrong("what is committed is whole", f"{name}: {problem.what}")
            recording, note = Recording(folder), reported.get(name, {})
            if not recording.record.simulated:
                raise Wrong("nothing simulated is unmarked", name)
            if "rows" in note:
                with recording.open() as reader:
                    found = reader.column("streams/grip/value")
                sent = np.arange(note["first"], note["first"] + note["rows"])
                if not np.array_equal(found, sent):
                    raise Wrong("what was sent is stored", f"{name}: {len(found)} of {len(sent)}")
        self.others = now

    def _check_copies(self, notes: list[dict[str, Any]]) -> None:
        """What the remote store shows is there in whole; what was pulled is a trial of ours."""
        remote = self._folder.parent / "remote" / "campaigns" / NAME
        shown: dict[str, dict[str, str]] = {}
        for path in sorted([*remote.glob("*.json"), *remote.glob("*/*.json")]):
            files = {name: known["sha256"] for name, known in read_json(path)["files"].items()}
            if path.parent.name == "trials":
                shown[path.stem] = files
            for name, sha in files.items():
                here = remote / "objects" / sha
                if sha in self.spoilt:
                    if here.exists() and self._sum(here) == sha:
                        self.spoilt.discard(sha)
                elif not here.exists() or self._sum(here) != sha:
                    raise Wrong("what is pushed is whole", f"{path.stem}/{name}")
        folder = self._folder.parent / "pulled" / "campaigns" / NAME / "trials"
        now = {path.name: self._sums(path) for path in folder.iterdir()} if folder.is_dir() else {}
        for name, sums in now.items():
            if self._pulled.get(name) != sums and sums not in self.takes.get(name, ()):
                raise Wrong("what is pulled is whole", name)
        self._pulled = now
        for note in notes:
            if "pushed" in note and not note["problems"]:
                for name, sums in self.trials.items():
                    if name not in self.damaged and shown.get(name) != sums:
                        raise Wrong("what is reported is done", f"{name} was not pushed")
                    bad = self.spoilt & {*sums.values()} if note["check"] else set()
                    if name not in self.damaged and bad:
                        raise Wrong("what is reported is done", f"{name} was not read back")
            if "pulled" in note and not note["problems"]:
                for name in shown.keys() - now.keys():
                    raise Wrong("what is reported is done", f"{name} was not pulled")

    def _causes(self, trial: str) -> list[str]:
        return [
            str(item["cause"])
            for item in Campaign(self._campaign).quarantined()
            if item["trial"] == trial
        ]

    # -- what people asked for and read -----------------------------------------------------

    def _check_journals(self) -> None:
        now = {
            f"{name}/{path.name}": self._sum(path)
            for name in ("control", "log")
            if (self._folder / name).is_dir()
            for path in (self._folder / name).glob("*.json")
        }
        for name, known in self.files.items():
            if now.get(name) != known:
                raise Wrong("a log is true", f"{name} changed or went")
        self.files = now
        store = TrialStore.open(self._folder)
        faults: list[str] = []
        entries = log_entries(store, faults)
        if faults:
            raise Wrong("a log is true", faults[0].replace(str(self._folder), ""))
        # a kill may come between an entry and its note
        if self._logs and any(self._logs["logs"] in entry.text for entry in entries):
            self._take_log(self._logs["logs"], self._logs)
        for text, at_s in self.logged.items():
            when = [entry.when for entry in entries if text in entry.text]
            if not any(abs(datetime.fromisoformat(each).timestamp() - at_s) <= 1 for each in when):
                raise Wrong("a log is true", f"has '{text}' at {when or 'no time'}")
        there = {request.number: request.kind for request in control.requests(store)}
        # a kill may come between a request and its note
        self.asked = {n: kind for n, kind in there.items() if kind in self._begun} | self.asked
        for number, kind in self.asked.items():
            if there.get(number) != kind:
                raise Wrong("a log is true", f"request {number} ({kind}) is {there.get(number)}")

    def _check_status(self) -> None:
        """What `sliplab status` says is what is on the disk."""
        if not (self._campaign / "campaign.json").exists():
            return
        if self._status is None:
            self._status = StatusReader(TrialStore.open(self._folder))
        found = self._status.read()
        if found.running is not None:
            raise Wrong("nothing is left open", "the store is still held")
        (one,) = found.campaigns
        if one.problem is not None:
            raise Wrong("a status is true", one.problem.replace(str(self._folder), ""))
        out = {item["trial"] for item in one.excluded}
        cut = {name for name, (how, _) in self.damaged.items() if how == "cut"}
        # a changed byte is found by `verify` only; a kill may leave a trial where it was
        there = (self.trials.keys() | self._moving) - cut
        counts = (one.committed, one.planned - one.missing - len(out), one.simulated)
        if counts != (len(there), len(there), True):
            raise Wrong("a status is true", f"says {counts}, there are {len(there)}")
        by_person = {item["trial"] for item in one.excluded if item["by"] is not None}
        skipped = self._skipped() - there
        # a kill may have come between what was asked and its answer
        waiting = control.open_requests(TrialStore.open(self._folder))
        half = {trial for each in waiting for trial in each.trials}
        self._waiting = any(each.kind == "again" for each in waiting)
        if by_person - half != skipped - half:
            what = f"{sorted(by_person)} are skipped, asked and answered were {sorted(skipped)}"
            raise Wrong("requests are carried out", what)
        both = [kind for _, kind in sorted(self.asked.items()) if kind in {"pause", "resume"}]
        if (found.paused is not None) != (both[-1:] == ["pause"]):
            raise Wrong("a status is true", f"says it is paused: {found.paused}, asked was {both}")

    def _skipped(self) -> set[str]:
        """Return the trials that were skipped, by the requests and their answers."""
        store, found = TrialStore.open(self._folder), set[str]()
        for request in control.requests(store):
            did = ((control.answered(store, request) or {}).get("did") or {}).get("trials", {})
            for trial, text in did.items():
                place = text.partition("quarantine/")[2].partition(";")[0]
                if place and place not in self.aside:
                    raise Wrong("requests are carried out", f"{trial}: {text}")
                if request.kind == "skip" and "set aside" in text:
                    found.add(trial)
                elif request.kind == "again":
                    found.discard(trial)
        return found


def _is_complete(folder: Path) -> bool:
    """Return whether an unfinished trial has its record, and all that this states."""
    if not (folder / "record.json").exists() or (folder / "cause.json").exists():
        return False
    try:
        if (folder / "checksums.json").exists():
            return not verify_trial(folder)
        return not content_problems(folder, TrialRecord.load(folder / "record.json"))
    except (OSError, ValueError, KeyError, TypeError, RuntimeError):
        return False


def _without(sums: Sums) -> Sums:
    return {name: value for name, value in sums.items() if name not in LATER}
