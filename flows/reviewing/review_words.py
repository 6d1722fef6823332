"""What the review page says about a trial, as HTML; everything that people wrote is escaped."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from sliplab.flows.reviewing.review_trial import Shown
from sliplab.storage.trials.review import Decision, Onsets

KEYS = (
    ("n, &darr;", "next"), ("p, &uarr;", "previous"), ("&larr; &rarr;", "frame"),
    ("i, g", "line to the cursor"), ("a", "accept"), ("s", "adjust"), ("r", "reason, reject"),
    ("u", "reopen"), ("0", "lines back"), ("z", "zoom"),
)  # fmt: skip


def keys() -> str:
    """The keyboard, in one line."""
    return "<div class='keys'>" + " ".join(f"<kbd>{k}</kbd> {what}" for k, what in KEYS) + "</div>"


def heading(shown: Shown, position: str) -> str:
    """Which trial it is, what it was taken under, and why it is in doubt."""
    row = shown.row
    condition = shown.recording.record.condition
    levels = ", ".join(f"{name} {text}" for name, text in condition.items())
    who = f" by {escape(row.who)}" if row.who else ""
    badges = [f"<span class='state {row.state}'>{row.state}{who}</span>"]
    if shown.recording.simulated:
        badges.append("<span class='state simulated'>simulated</span>")
    reasons = [f"<li class='doubt'>{escape(text)}</li>" for text in row.reasons]
    if row.label != "fresh":
        words = {"missing": "There is no label yet", "stale": "This label is out of date"}
        reasons.insert(
            0, f"<li class='doubt'>{words[row.label]}: run `sliplab label`, then decide.</li>"
        )
    if row.state == "stale":
        reasons.insert(
            0, "<li class='doubt'>The last decision was made on a label that has changed since; "
            "it is not used.</li>",
        )  # fmt: skip
    if row.problem:
        reasons.insert(0, f"<li class='doubt'>{escape(row.problem)}</li>")
    if not reasons:
        reasons = ["<li>no reason for doubt</li>"]
    return (
        f"<h1>{escape(levels)} {' '.join(badges)}</h1>"
        f"<p class='id'>{escape(row.campaign)} / {escape(row.trial)} &middot; {position}</p>"
        f"<ul>{''.join(reasons)}</ul>"
    )


def lines(shown: Shown, onsets: Onsets) -> str:
    """Where the onset lines are, and how far from the label."""
    rows = []
    for kind in ("incipient", "gross"):
        now, was = getattr(onsets, f"{kind}_ns"), getattr(shown.onsets, f"{kind}_ns")
        far = "" if now is None or was is None else f"{(now - was) / 1e6:+.1f} ms"
        if was is None and now is not None and now == getattr(shown.suggested, f"{kind}_ns"):
            far = "suggested by the markers that were seen"
        rows.append(
            f"<tr><th class='{kind}'>{kind}</th><td>{_seconds(was)}</td>"
            f"<td>{_seconds(now)}</td><td>{far}</td></tr>"
        )
    return (
        "<table><tr><th>onset</th><th>label</th><th>line</th><th>moved</th></tr>"
        + "".join(rows)
        + "</table>"
    )


def flags(shown: Shown) -> str:
    """The gates that the trial passed, and what the label says of its quality."""
    cells = []
    for name, gate in shown.recording.record.quality.gates.items():
        mark = "" if gate.passed else " class='doubt'"
        limit = "" if gate.limit is None else f" (limit {gate.limit:g})"
        cells.append((f"<td{mark}>{escape(name)}</td>", f"{_plain(gate.value)}{limit}"))
    label = {} if shown.label is None else shown.label.to_json()
    for name in ("source", "rule", "reference", "markers_lost", "plate_lost", "camera_moved_px"):
        if label.get(name) is not None:
            cells.append((f"<td>{name}</td>", escape(_plain(label[name]))))
    if shown.label is not None and shown.label.quality:
        worst = min(shown.label.quality)
        which = shown.label.quality.index(worst)
        cells.append(("<td>worst marker</td>", f"{which}, quality {worst:.2f} of 1"))
    cells.append(("<td>clocks</td>", "fitted again" if shown.recording.refitted else "as recorded"))
    body = "".join(f"<tr>{name}<td>{value}</td></tr>" for name, value in cells)
    return f"<table class='flags'>{body}</table>"


def past(history: Sequence[Decision], key: str) -> str:
    """All decisions about a trial, the newest first."""
    if not history:
        return "<p class='id'>no decision yet</p>"
    rows = []
    for made in reversed(history):
        change = "" if made.verdict in {"accept", "reopen"} else (
            f"{_seconds(made.old.incipient_ns)}, {_seconds(made.old.gross_ns)} &rarr; "
            f"{_seconds(made.new.incipient_ns)}, {_seconds(made.new.gross_ns)}"
        )  # fmt: skip
        old = "" if made.label == key else " (on an older label)"
        rows.append(
            f"<tr><td>{made.number}</td><td>{escape(made.verdict)}{old}</td><td>{change}</td>"
            f"<td>{escape(made.who)}</td><td>{escape(made.when[:16].replace('T', ' '))}</td>"
            f"<td class='why'>{escape(made.why)}</td></tr>"
        )
    head = "<tr><th></th><th>decision</th><th>incipient, gross</th><th>who</th><th>UTC</th>"
    return f"<table class='past'>{head}<th>reason</th></tr>{''.join(rows)}</table>"


def _seconds(ns: int | None) -> str:
    return "&ndash;" if ns is None else f"{ns / 1e9:.4f} s"


def _plain(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


STYLE = """
:host { font-family: sans-serif; font-size: 13px; color: #20262c; }
h1 { font-size: 17px; margin: 0 0 2px; font-weight: 600; }
p { margin: 2px 0; } ul { margin: 2px 0; padding-left: 18px; }
.id { color: #666666; font-size: 12px; overflow-wrap: anywhere; }
.doubt { color: #b04700; }
.state { font-size: 12px; padding: 1px 7px; border-radius: 8px; background: #e8ebee;
  font-weight: 400; vertical-align: 2px; }
.state.accepted { background: #cdeee2; } .state.adjusted { background: #d5e6f4; }
.state.rejected { background: #f9ddcf; } .state.stale { background: #fbe9c0; }
.state.simulated { background: none; border: 1px solid #999; font-style: italic; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
td, th { padding: 1px 10px 1px 0; text-align: left; font-weight: 400; vertical-align: top;
  white-space: nowrap; }
tr:first-child th { color: #666666; }
th.incipient { color: #b87d00; font-weight: 600; } th.gross { color: #D55E00; font-weight: 600; }
.past td.why { white-space: normal; overflow-wrap: anywhere; }
.flags td { font-size: 12px; padding-bottom: 0; }
kbd { border: 1px solid #bbb; border-radius: 3px; padding: 0 4px; background: #f4f5f6; }
.keys { color: #666666; font-size: 12px; line-height: 1.7; }
.good { color: #00664a; } .bad { color: #b04700; font-weight: 600; }
"""
