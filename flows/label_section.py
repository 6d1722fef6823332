"""The report's words on the labels: how far both rules are apart, and each from the truth."""

from __future__ import annotations

from typing import Any

from analysis.report import Section, Table, number, percent
from flows.results import source_text

_ROWS = (
    ("paper", "paper's rule less the true crossing"),
    ("change_point", "change point less the true start of the slip"),
    ("apart", "paper's rule less the change point"),
)


def section(summary: dict[str, Any]) -> Section | None:
    """Both rules against the simulation's truth; None where nothing is labelled by both."""
    rules = summary["labels"]["rules_ms"]
    if not rules["apart"]["incipient"]["n"]:
        return None
    known = rules["paper"]["incipient"]["n"] > 0
    rows = []
    for name, title in _ROWS if known else _ROWS[2:]:
        for kind in ("incipient", "gross"):
            values = rules[name][kind]
            rows.append(
                [
                    title,
                    f"{kind} onset",
                    str(values["n"]),
                    number(values["median"], 2),
                    number(values["median_abs"], 2),
                    number(values["max_abs"], 2),
                ]
            )
    said = [
        f"Labels are read from {source_text(summary)} alone. The paper dates a slip by the frame "
        "in which a marker has gone 2 pixels; the change point says when the papilla let go, with "
        f"an interval. Which of them rules is the protocol's: here {_ruling(summary)}."
    ]
    if known:
        papillae = rules["papillae"]
        said.append(
            "The mock rig knows both moments, and nothing else reads them. Over "
            f"{papillae['n']} papilla slips (simulated) the change point is "
            f"{number(papillae['median_abs'], 2, 'ms')} off in the median, and its 95 % interval "
            f"holds the truth in {percent(papillae['coverage'])} of them."
        )
    columns = ["difference", "onset", "trials", "median (ms)", "median distance", "largest"]
    return Section(
        "How exact the labels are", said, (), [Table(columns, rows, "One frame is 10 ms.")]
    )


def _ruling(summary: dict[str, Any]) -> str:
    words = {"paper": "the paper's rule", "change_point": "the change points"}
    names = summary["labels"]["error_ms"]["rule"].split("+")
    return " and ".join(words.get(name, name) for name in names)
