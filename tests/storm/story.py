"""Stories: what happens to one campaign, as a list of steps that JSON can hold, drawn from a seed.

A step is ``{"do": KIND, ...}``. `WEATHER` of a step is what befalls its process: a kill at one of
its writes, a power cut, a full, failing or read-only disk. Every draw comes from the seed.
"""

from __future__ import annotations

import copy
import random
from collections.abc import Callable, Iterator
from typing import Any

from sliplab.flows.planning.disk_space import RESERVE
from tests.conftest import ROOT
from tests.crash.campaign import protocol
from tests.storm.lies import OF_ARM, OF_FORCE

Story = dict[str, Any]
Step = dict[str, Any]
Draw = Callable[[random.Random], dict[str, Any]]

DEVICES = ("arm", "event_camera", "frame_camera", "sync_box")


def _device(rng: random.Random, *but: str) -> dict[str, Any]:
    return {"device": rng.choice([name for name in DEVICES if name not in but])}


FAULTS: dict[str, Draw] = {
    "arm_protective_stop": lambda rng: {},
    "arm_off_path": lambda rng: {
        "mm": rng.choice([0.3, 1, 3, 10]),
        "seconds": rng.choice([0.3, 2]),
    },
    "frames_lost": lambda rng: {"count": rng.choice([1, 5])},
    "frame_late": lambda rng: {"seconds": rng.choice([0.05, 0.5])},
    "event_gap": lambda rng: {"seconds": rng.choice([0.02, 0.3])},
    "event_stall": lambda rng: {"seconds": rng.choice([0.1, 1])},
    "event_burst": lambda rng: {"seconds": 0.02},
    "clock_drift": lambda rng: {**_device(rng), "ppm": rng.choice([-20, 20, 200, 2000])},
    "clock_jump": lambda rng: {**_device(rng), "seconds": rng.choice([-5000, -0.01, 0.003, 0.25])},
    "clock_restart": lambda rng: _device(rng, "sync_box"),
    "pulses_lost": lambda rng: {"count": rng.choice([1, 5, 50]), **_device(rng, "frame_camera")},
    "pulses_duplicated": lambda rng: {"count": 5, **_device(rng, "frame_camera")},
    "pulses_late": lambda rng: {"count": rng.choice([1, 30]), **_device(rng, "frame_camera")},
    "papilla_torn": lambda rng: {"papilla": rng.choice([0, 5])},
    "marker_occluded": lambda rng: {"papilla": 0},
    "plate_stuck": lambda rng: {},
    "papilla_sticky": lambda rng: {"papilla": 3},
    "skin_wear": lambda rng: {},
    "plate_spot": lambda rng: {"centre_mm": [2, 1], "radius_mm": 2},
    "mains_light": lambda rng: {"share": 0.08},
    "knock": lambda rng: {},
    "shaking": lambda rng: {},
    "event_noise": lambda rng: {},
    "skin_brushed": lambda rng: {},
    "arm_ramp": lambda rng: {"mm_s2": rng.choice([1, 20])},
    "disk_full": lambda rng: {},
    "device_gone": lambda rng: {**_device(rng), **rng.choice([{}, {"seconds": 0.3}])},
    "stream_gone": lambda rng: {"stream": "warm"},
}
"""Parameters of each kind of `rigs.core.faults` that a rig file may name."""
COMMIT = ("=1/record.json", "=1/checksums.json", "=1/.cause.json", "/trials", "/trials")
NIGHT = (
    *("=1/data.h5", "=1/provenance.json", "=1/journal.jsonl", "/skipped.json", "/control"),
    *("/incoming", "/quarantine", "/campaign.json", "/bench", "/store.json", "/rig.yaml"),
)
ASKED = ("/control", ".done.json", "/skipped.json", "/quarantine", "/log", "=1/.cause.json")
NAMES = {
    "night": (COMMIT, NIGHT),
    "push": (("/objects", "/objects", "/remote/"),),
    "pull": (("/pulled/", "=1/data.h5", "/incoming", "/trials"),),
    "between": (ASKED,),
}
"""Parts of paths, each of which a kill or a power cut of a step may wait for."""
CALLS = {"write": 9.5, "fsync": 5.5, "rename": 3.3, "any": 9.7}
"""Calls of a night that change a file, by kind: powers of two."""
WHOLE_TRIALS = {"plate_stuck", "papilla_sticky", "skin_wear", "plate_spot", "arm_ramp"}
SHARP = (
    *("arm_protective_stop", "arm_off_path", "frames_lost", "frame_late", "event_gap"),
    *("event_stall", "clock_drift", "clock_jump", "clock_restart", "pulses_lost"),
    *("pulses_duplicated", "pulses_late", "disk_full", "device_gone", "stream_gone"),
)
"""Kinds that a gate or a watch is there for; they are drawn more often."""
OF_ANY = {"clock_drift", "clock_jump", "device_gone"}
"""Kinds that a force sensor has, too."""
ALONE = {"mains_light", "arm_ramp"}
"""Kinds of which a trial has one at most."""


def draw(seed: int) -> Story:
    """Return the story of a seed."""
    rng = random.Random(seed)
    rig = _rig(rng)
    # with a force limit, which is looked at all the time, a second costs six times as much
    hold_s = rng.choice([0.5, 5] if "force" in rig["limits"] else [0.5, 5, 60, 240])
    events = "events" in rig.get("cameras", ["events"])
    if hold_s > 5:
        rig["poll"] = "1 s"
    story = {"seed": seed, "protocol": _protocol(rng, hold_s, events), "rig": rig}
    trials = len(story["protocol"]["collection"]["factors"]["direction"]["values"])
    kinds = [kind for kind in STEPS if events or kind not in OF_EVENTS]
    steps: list[Step] = []
    for number in range(rng.randint(8, 14)):
        kind = rng.choices(kinds, [STEPS[name][0] for name in kinds])[0] if number else "night"
        last = steps[-1] if steps else {}
        weather = last.get("weather", {})
        ended = weather.get("kill") or weather.get("power")
        if ended and ended.get("name") == "/trials" and rng.random() < 0.5:
            kind = "damage"  # a trial that is complete, and not yet committed
        elif (ended or last.get("do") in {"push", "damage"}) and rng.random() < 0.5:
            kind = rng.choice(FOLLOWS.get(last["do"], ("verify",)))
        step = {"do": kind, **STEPS[kind][1](rng, story, trials)}
        if kind == "damage" and last["do"] == "push":
            step["where"] = "remote"
        elif kind == "damage" and ended and last["do"] == "night":
            step["where"] = "incoming"
        steps.append(step)
    return {**story, "steps": steps}


def _protocol(rng: random.Random, hold_s: float, events: bool) -> dict[str, Any]:
    data = protocol(rng.randint(4, 9))
    data["name"] = "storm"
    collection = data["collection"]
    collection["seed"] = rng.randrange(10_000)
    factors = collection["factors"]
    factors["depth"]["values"] = [rng.choice([2.0, 2.4, 3.2])]
    factors["speed"]["values"] = [rng.choice([0.4, 0.4, 1.6, 4.0])]
    collection["motion"][3]["distance"] = f"{rng.choice([1.6, 4, 8])} mm"
    settle_s = rng.choice([0.2, 10])
    collection["motion"][2] |= {"settle": f"{settle_s} s", "duration": f"{hold_s} s"}
    collection["limits"] = {**collection.get("limits", {}), "duration": "300 s"}
    collection["gates"]["sync_uncertainty"]["digital_input"] = rng.choice(["3 ms", "0.0016 ms"])
    collection["gates"]["retakes"] = rng.choice([0, 2, 3])
    warm_up = {"presses": 2, "depth": "2.4 mm", "speed": "2 mm/s", "clearance": "5 mm"}
    rezero = {"every": rng.choice([3, 7]), "speed": "0.5 mm/s", "search": "0.5 mm"}
    both = {"warm_up": warm_up, "rezero": rezero}
    collection["maintenance"] = rng.choice([{}, both, {"rezero": rezero}])
    if events and rng.random() < 0.4:
        condition = {name: factors[name]["values"][0] for name in ("depth", "speed", "direction")}
        collection["references"] = {"every": 2, "condition": condition}
        collection["gates"]["reference"] = {"event_rate": rng.choice(["20 %", "60 %"])}
    return data


def _rig(rng: random.Random) -> dict[str, Any]:
    rig: dict[str, Any] = {
        "extends": str(ROOT / "rigs" / "rehearsal.yaml"),
        "name": "storm",
        "mock": {"seed": rng.randrange(1000)},
        "poll": rng.choice(["0.5 s", "1 s", "1 s", "1 s"]),
        # close around the motion, so that leaving the path is leaving the limits
        "limits": {"depth": "3.4 mm", "speed": "50 mm/s", "reach": "9 mm"},
    }
    rig["timing"] = {"code": rng.choice(["lfsr", "lfsr", "irregular", "regular"])}
    if rng.random() < 0.3:
        grades = ["exposure line", "device time stamps", "host arrival"]
        rig["timing"]["frames"] = rng.choice(grades)
    if rng.random() < 0.15:
        rig["timing"]["arm"] = "host time"
    if rng.random() < 0.4:
        rig["cameras"] = [rng.choice(["events", "frames", "frames"])]
    if rng.random() < 0.4:
        delay = {"shortest_us": 0, "longest_us": 4000}
        rig["timing"]["force"] = {"grade": "host time", "delay": delay}
        rig["mock"]["force"] = {"rate_hz": 500}
        if rng.random() < 0.6:
            rig["limits"]["force"] = "12 N"
    if rng.random() < 0.3:
        thermometer = {"kind": "scalar", "unit": "degC", "mock": {"rate_hz": 20}}
        thermometer["timing"] = {"delay": {"shortest_us": 0, "longest_us": 4000}}
        rig["streams"] = {"warm": thermometer}
    return rig


def _trial_s(story: Story) -> float:
    """Return about how long a trial takes, with what is done before it."""
    collection = story["protocol"]["collection"]
    motion, speed = collection["motion"], collection["factors"]["speed"]["values"][0]
    seconds = sum(float(motion[2][name].split()[0]) for name in ("settle", "duration"))
    return 8 + seconds + float(motion[3]["distance"].split()[0]) / float(speed)


# -- steps ---------------------------------------------------------------------------------------


def _faults(rng: random.Random, story: Story, trials: int = 4) -> list[dict[str, Any]]:
    """Draw none to three faults of a night that takes so many trials."""
    found: list[dict[str, Any]] = []
    for _ in range(rng.choice([0, 0, 1, 1, 2, 3])):
        kind = rng.choice([*FAULTS, *SHARP, *SHARP])
        if kind in ALONE and any(fault["kind"] == kind for fault in found):
            continue
        wired = story["rig"]["timing"].get("arm") != "host time"
        if kind == "stream_gone" and "streams" not in story["rig"]:
            continue
        fault = {"kind": kind, **FAULTS[kind](rng)}
        if not wired and kind.startswith("pulses") and fault["device"] == "arm":
            continue
        if "force" in story["rig"]["mock"] and kind in OF_ANY and rng.random() < 0.3:
            fault["device"] = "force_sensor"
        if rng.random() < 0.8:
            fault["trial"] = rng.randint(1, trials + 2)  # a touch counts as one
        if kind not in WHOLE_TRIALS:
            fault["at_s"] = round(rng.uniform(0, rng.choice([4, _trial_s(story)])), 2)
        if kind not in WHOLE_TRIALS and rng.random() < 0.3:
            fault["since"] = "trial"
        found.append(fault)
    return found


def _weather(rng: random.Random, step: str, share: float = 0.45) -> dict[str, Any]:
    if rng.random() > share:
        return {}
    kind = rng.choice([*CALLS])
    kill = {"kind": kind, "at": round(2 ** rng.uniform(0, CALLS[kind]))}
    cut: Step = {"at": round(2 ** rng.uniform(2, CALLS["any"]))}
    if rng.random() < 0.7:  # at one of few calls, which would be met seldom among all
        name = rng.choice(rng.choice(NAMES[step]))
        kill = {"kind": "any", "at": round(2 ** rng.uniform(0, 3)), "name": name}
        cut = {"at": kill["at"], "name": kill["name"]}
    full = {"room": round(2 ** rng.uniform(8, 21)), "errno": rng.choice([28, 28, 5])}
    drawn: list[Step] = [
        {"kill": {**kill, "share": rng.choice([0.0, 0.3, 1.0])}},
        {"power": {**cut, "torn": rng.choice([None, rng.randrange(1000)])}},
        {"full": full},
        {"low": {"free": rng.choice([0, 150_000_000, RESERVE + 2000, RESERVE + 20_000])}},
        {"read_only": {}},
    ]
    made = rng.choices(drawn, [4, 4, 2, 1, 1])[0]
    return {"weather": made}


def _ask(rng: random.Random, story: Story, trials: int) -> Step:
    """Draw what an operator asks for."""
    kinds = ["pause", "pause", "resume", "stop", "skip", "again", "again"]
    made: Step = {"ask": rng.choice(kinds)}
    if made["ask"] in {"skip", "again"}:
        made["trials"] = [rng.randrange(trials)]
    return made


def _event(rng: random.Random, story: Story, trials: int, night_s: float) -> Step:
    """Draw what happens at some time of a night, which takes about `night_s`."""
    drawn: list[Step] = [
        _ask(rng, story, trials),
        {"signal": rng.choice(["SIGINT", "SIGTERM", "SIGHUP", "dropped", "dropped"])},
        {"log": {"skin": str(rng.randint(2, 5))}},
        {"log": {}},
        {"clock": rng.choice([-7200, -3, 40, 90_000])},
        {"rival": True},
        {"look": True},
        {"suspend": rng.choice([0.3, 5.0, 600.0])},
        {"fill": rng.choice([0, RESERVE + 2000, RESERVE + 20_000])},
        _lie(rng, story),
    ]
    made = rng.choices(drawn, [4, 2, 3, 1, 1, 1, 1, 1, 1, 7])[0]
    return {"at_s": round(rng.uniform(0, 1.1 * night_s), 2), **made}


def _lie(rng: random.Random, story: Story) -> Step:
    limited = "force" in story["rig"]["limits"]
    kinds = (*OF_ARM, *OF_FORCE, *OF_FORCE) if limited else OF_ARM
    lie = {"lie": rng.choice(kinds), "axis": rng.randrange(6)}
    return {**lie, "seconds": rng.choice([1.5, 20.0, 1e9])}


def _night(rng: random.Random, story: Story, trials: int) -> Step:
    most = rng.choice([None, None, 1, 2, 2, 3])  # so that later nights have trials left
    night_s = (most or trials) * _trial_s(story)
    events = [_event(rng, story, trials, night_s) for _ in range(rng.choice([0, 1, 2, 3, 4]))]
    for event in [each for each in events if each.get("ask") == "pause"]:
        if rng.random() < 0.8:  # who pauses goes on again, mostly
            end_s = round(event["at_s"] + rng.uniform(0, 3 * night_s), 2)
            events.append({"at_s": end_s, "ask": "resume"})
    window = {"window_s": round(rng.uniform(0, 1.2 * night_s), 1)} if rng.random() < 0.15 else {}
    return {
        "faults": _faults(rng, story, most or trials),
        "events": sorted(events, key=lambda event: event["at_s"]),
        "most": most,
        **window,
        **_weather(rng, "night"),
    }


def _damage(rng: random.Random, story: Story, trials: int) -> Step:
    where = rng.choice(["trials", "trials", "incoming", "remote"])
    return {"trial": rng.randrange(trials), "where": where, "how": rng.choice(["cut", "flip"])}


def _copy(rng: random.Random, kind: str) -> Step:
    fails = rng.choice([0, round(2 ** rng.uniform(1, 7))])  # at any of its calls
    step = {"fails": fails, "short": rng.random() < 0.3}
    return {**step, "check": rng.random() < 0.2, **_weather(rng, kind)}


def _record(rng: random.Random, story: Story, trials: int) -> Step:
    rows = [rng.randint(1, 300) for _ in range(rng.randint(1, 2))]
    # its thread writes in real time: the power fails when all is done, or not at all
    cut = {"weather": {"power": {"at": 10**9, "torn": rng.choice([None, rng.randrange(1000)])}}}
    step = {"first": rng.randrange(1000), "rows": rows, "fails": rng.random() < 0.3}
    return {**step, **(cut if rng.random() < 0.3 else {})}


def _carry(rng: random.Random, story: Story, trials: int) -> Step:
    return {"trial": rng.randrange(trials), "form": rng.choice(["aedat4", "dsec"])}


def _react(rng: random.Random, story: Story, trials: int) -> Step:
    faults = _faults(rng, story) if rng.random() < 0.4 else []
    step = {"trial": rng.randrange(trials), "level": rng.choice([40.0, 400.0])}
    return {**step, "reflex": rng.choice(["stop", "press:0.2"]), "faults": faults}


def _between(rng: random.Random, story: Story, trials: int) -> Step:
    return {**_ask(rng, story, trials), **_weather(rng, "between", 0.2)}


def _note(rng: random.Random, story: Story, trials: int) -> Step:
    return {"skin": rng.choice(["2", "3"]), **_weather(rng, "between", 0.2)}


def _probe(rng: random.Random, story: Story, trials: int) -> Step:
    # with a force limit, what is deep is beyond it
    deep = [-5.0] if "force" in story["rig"]["limits"] else [-5.0, -1.0, -0.1]
    places = [
        [
            rng.choice([*deep, *deep, 0.1, 2.0]),
            rng.choice([-8.0, -1.0, -0.1, 0.1, 2.0]),
            round(rng.uniform(0, 6.28), 2),
            rng.choice([0.2, 0.99, 0.99, 1.01, 2.0, 0.0]),
        ]
        for _ in range(12)
    ]
    return {"places": places}


def _serve(rng: random.Random, story: Story, trials: int) -> Step:
    return {"seed": rng.randrange(10_000), "lost": rng.choice([0.0, 0.1, 0.4])}


STEPS: dict[str, tuple[float, Callable[[random.Random, Story, int], Step]]] = {
    "night": (12, _night),
    "ask": (2, _between),
    "log": (0.7, _note),
    "verify": (0.5, lambda rng, story, trials: {"quarantine": rng.random() < 0.5}),
    "damage": (1, _damage),
    "import": (0.5, lambda rng, story, trials: _weather(rng, "pull")),
    "push": (1.5, lambda rng, story, trials: _copy(rng, "push")),
    "pull": (1.5, lambda rng, story, trials: _copy(rng, "pull")),
    "serve": (1, _serve),
    "record": (0.4, _record),
    "carry": (0.4, _carry),
    "react": (0.3, _react),
    "probe": (0.6, _probe),
    "alert": (1, _serve),
}
"""Kinds of steps: how often they are drawn, and what draws their particulars."""
OF_EVENTS = {"carry", "react"}
"""Kinds of steps that a rig without an event camera does not have."""
FOLLOWS = {
    "night": ("night", "night", "verify", "damage", "push", "ask"),
    "push": ("pull", "pull", "push", "damage", "night", "night"),
    "pull": ("pull", "push", "damage", "night"),
    "damage": ("verify", "night", "night", "push", "pull"),
}
"""What often follows a step that ended in a kill or a power cut, or changed what others read."""


def shorter(story: Story) -> Iterator[Story]:
    """Yield stories that lack one part of this one, the largest parts first."""
    for index in range(len(story["steps"])):
        made = copy.deepcopy(story)
        del made["steps"][index]
        yield made
    for index, step in enumerate(story["steps"]):
        for key in ("faults", "events"):
            for part in range(len(step.get(key, ()))):
                made = copy.deepcopy(story)
                del made["steps"][index][key][part]
                yield made
        if "weather" in step:
            made = copy.deepcopy(story)
            del made["steps"][index]["weather"]
            yield made
    directions = story["protocol"]["collection"]["factors"]["direction"]["values"]
    if len(directions) > 2:
        made = copy.deepcopy(story)
        del made["protocol"]["collection"]["factors"]["direction"]["values"][-1]
        yield made
