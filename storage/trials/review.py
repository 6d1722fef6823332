"""What people decided about automatic labels: apart from them, append only, one file a decision.

    STORE/review/CAMPAIGN/TRIAL/000001.json   the first decision about a trial's label, and so on

A decision names the label that it was made on by that label's key, so that it can be told when the
label has changed since. The last decision counts; the ones before it stay. A number is taken by
whoever writes its file first, so two people who decide on one trial at the same time both keep what
they decided, or the second one is told. No lock is needed: only this program's files stand here.
"""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Literal, get_args

from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, read_json, safe_name, write_new_json
from sliplab.storage.process import now, user_name
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store

Verdict = Literal["accept", "adjust", "reject", "reopen"]
FOLDER = "review"
_FILE = re.compile(r"(\d{6,12})\.json")
_FORMAT = 1


class Overtaken(StoreError):
    """Somebody else decided about this trial first; the message says who, and what."""


@dataclass(frozen=True)
class Onsets:
    """Two onsets on the trial's time line, ns; None where there is none, or it is not known."""

    incipient_ns: int | None = None
    gross_ns: int | None = None

    def problem(self) -> str | None:
        """Why these cannot be the onsets of a trial, in words; None if they can."""
        if self.gross_ns is not None and self.incipient_ns is None:
            return "a gross onset needs an incipient one"
        if None not in (self.gross_ns, self.incipient_ns) and self.gross_ns < self.incipient_ns:  # type: ignore[operator]  # neither is None
            return "the gross onset must not come before the incipient one"
        return None


@dataclass(frozen=True)
class Decision:
    """One decision of a person about one label.

    Attributes:
        number: its place in the trial's history, from 1.
        verdict: ``accept`` (the label stands), ``adjust`` (the onsets are these), ``reject`` (the
            trial is not to be used) or ``reopen`` (nothing is decided any more).
        when: UTC, ISO 8601.
        label: key of the label that it was made on.
        old: the label's onsets; new: those that hold by this decision.
    """

    number: int
    verdict: Verdict
    who: str
    when: str
    why: str
    host: str
    label: str
    old: Onsets
    new: Onsets

    def __str__(self) -> str:
        why = f" ({self.why})" if self.why else ""
        return f"{self.verdict} by {self.who}, {self.when}{why}"


def decide(
    store: Store,
    campaign: str,
    trial: str,
    verdict: Verdict,
    *,
    label: str,
    old: Onsets,
    new: Onsets,
    seen: int,
    who: str = "",
    why: str = "",
) -> Decision:
    """Keep a decision, after all that were made before.

    Args:
        label: key of the label that was looked at.
        seen: number of the last decision that was looked at, 0 for none.

    Raises:
        Overtaken: there is a newer decision than `seen`; nothing was written.
        ValueError: a rejection without a reason, or onsets that cannot be.
        OSError: it cannot be written.
    """
    if verdict not in get_args(Verdict):
        raise ValueError(f"verdict = {verdict!r}: must be one of {', '.join(get_args(Verdict))}")
    if verdict == "reject" and not why.strip():
        raise ValueError("a rejection needs a reason")
    if verdict == "adjust" and (problem := new.problem()) is not None:
        raise ValueError(problem)
    made = Decision(
        seen + 1, verdict, who or user_name(), now(), why.strip(), socket.gethostname(), label,
        old, new,
    )  # fmt: skip
    folder = _folder(store, campaign, trial)
    make_folder(folder)
    numbers = _numbers(folder)
    if max(numbers, default=0) == seen and write_new_json(_path(folder, made.number), _data(made)):
        return made
    newest = history(store, campaign, trial)[-1]
    raise Overtaken(f"{trial}: meanwhile there is another decision: {newest}")


def history(store: Store, campaign: str, trial: str) -> list[Decision]:
    """All decisions about a trial in their order.

    Raises:
        StoreError: one of them is damaged.
    """
    folder = _folder(store, campaign, trial)
    return [_read(_path(folder, number), number) for number in _numbers(folder)]


def last(store: Store, campaign: str, trial: str) -> Decision | None:
    """The decision that counts; None where nobody decided.

    Raises:
        StoreError: it is damaged.
    """
    folder = _folder(store, campaign, trial)
    numbers = _numbers(folder)
    return _read(_path(folder, numbers[-1]), numbers[-1]) if numbers else None


def counts(store: Store, campaign: str) -> dict[str, int]:
    """How many decisions there are, by trial; trials without one are left out."""
    folder = store.folder / FOLDER / safe_name(campaign)
    if not folder.is_dir():
        return {}
    found = {path.name: len(_numbers(path)) for path in folder.iterdir() if path.is_dir()}
    return {name: count for name, count in found.items() if count}


def _folder(store: Store, campaign: str, trial: str) -> Path:
    return store.folder / FOLDER / safe_name(campaign) / safe_name(trial)


def _path(folder: Path, number: int) -> Path:
    return folder / f"{number:06d}.json"


def _numbers(folder: Path) -> list[int]:
    if not folder.is_dir():
        return []
    found = (_FILE.fullmatch(path.name) for path in folder.iterdir())
    return sorted(int(match[1]) for match in found if match)


def _data(made: Decision) -> Json:
    plain = {item.name: getattr(made, item.name) for item in fields(made)}
    onsets = {"old": vars(made.old), "new": vars(made.new)}
    return {name: value for name, value in plain.items() if name != "number"} | {
        **onsets, "format": _FORMAT
    }  # fmt: skip


def _read(path: Path, number: int) -> Decision:
    try:
        data = read_json(path)
        if data["format"] > _FORMAT:
            raise StoreError(f"{path}: was written by a newer version of SlipLab: update it")
        if data["verdict"] not in get_args(Verdict):
            raise ValueError(f"verdict = {data['verdict']!r}")
        texts = {name: str(data[name]) for name in ("who", "when", "why", "host", "label")}
        old, new = (_onsets(data[name]) for name in ("old", "new"))
        if data["verdict"] == "adjust" and (problem := new.problem()) is not None:
            raise ValueError(problem)
    except StoreError:
        raise
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StoreError(
            f"{path}: is no decision ({type(error).__name__}: {error}); put it back from a copy, "
            "or move it away and decide again"
        ) from None
    return Decision(number, data["verdict"], **texts, old=old, new=new)


def _onsets(data: Json) -> Onsets:
    values = {name: data[name] for name in ("incipient_ns", "gross_ns")}
    for name, value in values.items():
        if value is not None and (isinstance(value, bool) or not isinstance(value, int)):
            raise ValueError(f"{name} = {value!r}: must be whole nanoseconds")
        if value is not None and abs(value) >= 2**63:
            raise ValueError(f"{name} = {value}: must be less than 2^63 ns in size")
    return Onsets(**values)
