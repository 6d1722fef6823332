"""What the program prints and writes, with the parts replaced that differ from run to run."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer

from sliplab.analysis.report.sources import report_folder
from sliplab.flows.cli.app import command_line
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from tests.command_line import answer, here
from tests.conftest import ROOT
from tests.flows.collecting.test_session import short
from tests.flows.conftest import write
from tests.flows.older import older_store

FIXTURES = Path(__file__).parent / "fixtures"
QUICK_ANSWERS = (
    ("rigs",),
    ("plan", "kinematic", "--rig", "rehearsal"),
    ("plan", "gravity", "--rig", "rehearsal"),
    ("plan", "disturbance", "--rig", "rehearsal"),
)
STORE_ANSWERS = ("trials", "verify", "sync", "label")
LONG = 12_000
_TIMES = (
    (r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|[+-]\d\d:?\d\d)?", "TIME"),
    (r"\b[0-9a-f]{64}\b", "HASH"),
)


def help_text() -> str:
    """Return the help of every command, one after the other."""
    text = "".join(f"$ {words} --help\n{text}\n" for words, text in _helps())
    text = re.sub(r"Usage: .*?sliplab", "Usage: sliplab", text)  # by which program it runs
    return re.sub(r" +$", "", text, flags=re.MULTILINE)


def _helps() -> Iterator[tuple[str, str]]:
    waiting: list[tuple[tuple[str, ...], Any]] = [((), typer.main.get_command(command_line()))]
    while waiting:
        words, command = waiting.pop()
        yield " ".join(("sliplab", *words)), here(*words, "--help").stdout
        below = getattr(command, "commands", {})
        waiting += [((*words, name), below[name]) for name in sorted(below, reverse=True)]


def answers(folder: Path) -> dict[str, Any]:
    """Return the JSON of commands, of shipped files and of a store of an older version."""
    store = older_store(folder / "older")
    asked = [*QUICK_ANSWERS, *((name, str(store)) for name in STORE_ANSWERS)]
    return {
        " ".join(words).replace(str(folder), "FOLDER"): _short(neutral(answer(*words), folder))
        for words in asked
    }


def _short(value: Any) -> Any:
    """Return a long text's hash."""
    text = json.dumps(value)
    return value if len(text) < LONG else hashlib.sha256(text.encode()).hexdigest()


def checksums(folder: Path) -> dict[str, str]:
    """Collect three slides on the simulated rig; return the checksum of each trial."""
    protocol = write(folder / "short.yaml", short())
    answer("collect", protocol, "--rig", "rehearsal", "--store", folder / "store")
    return {
        each.trial_id: each.checksum
        for campaign in TrialStore.open(folder / "store").campaigns()
        for each in campaign.recordings()
    }


def study_of(store: Path) -> dict[str, Any]:
    """Return the summary and the text of the report of a studied store.

    Numbers have six digits.
    """
    report = report_folder(TrialStore.open(store))
    summary = read_json(report / "summary.json")
    for name in ("timing_s", "versions"):
        summary.pop(name)
    page = (report / "index.html").read_text()
    page = re.sub(r"(?s)<style>.*?</style>|<svg.*?</svg>|<[^>]*>", " ", page)
    page, *_ = page.split("wall time (s)")  # and versions
    page = re.sub(r"\s*\n\s*", "\n", page).strip()
    rounded = rounded_to(6, neutral(summary, store))
    return {
        "summary": {name: _short(each) for name, each in rounded.items()},
        "page": neutral(page, store).splitlines(),
    }


def processor() -> str:
    """Return the processor's maker and commands: each trains another network."""
    import torch

    lines = Path("/proc/cpuinfo").read_text().splitlines()
    named = [line.partition(":")[2].strip() for line in lines if line.startswith("vendor_id")]
    return f"{named[0] if named else 'unknown'}-{torch.backends.cpu.get_cpu_capability()}"


def rounded_to(digits: int, value: Any) -> Any:
    """Round numbers to what summing in another order leaves."""
    if isinstance(value, float):
        return float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {name: rounded_to(digits, each) for name, each in value.items()}
    return [rounded_to(digits, each) for each in value] if isinstance(value, list) else value


def neutral(value: Any, folder: Path) -> Any:
    """Return JSON without times, hashes and the places of files."""
    text = json.dumps(value)
    for place, word in (
        (folder, "FOLDER"),
        (ROOT / ".links" / "sliplab", "SHIPPED"),
        (ROOT, "ROOT"),
    ):
        text = text.replace(str(place), word)
    for pattern, word in _TIMES:
        text = re.sub(pattern, word, text)
    return json.loads(text)
