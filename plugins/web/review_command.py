"""`sliplab review`: manual label review."""

from __future__ import annotations

from contextlib import closing
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.cli.common import ANALYSE, CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.plugins.web.review.order import ReviewOrder, Waiting
    from sliplab.plugins.web.review.trial_list import TrialList

app = typer.Typer()
COUNT = 20
"""Trials that `--next` prints by default."""


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab review my-store")
def review(
    store: StoreArgument,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the page; default: a free one.")
    ] = 0,
    campaign: CampaignOption = None,
    who: Annotated[
        str, typer.Option("--who", help="Reviewer's name; default: the login name.")
    ] = "",
    by_change: Annotated[
        bool,
        typer.Option("--next", help="Begin with the trials whose review would change most."),
    ] = False,
    count: Annotated[
        int | None,
        typer.Option(
            "--count", min=1, max=1_000_000, help="Trials that --next prints; default: 20."
        ),
    ] = None,
    page: Annotated[
        bool, typer.Option("--page/--no-page", help="With --next: serve the page, or only print.")
    ] = True,
    as_json: JsonOption = False,
) -> None:
    """Review the labels in a browser on this computer; Ctrl-C ends it.

    Decisions are kept in STORE/review; `train` and `evaluate` use them with --reviewed.
    """
    from sliplab.plugins.web.review.trial_list import TrialList
    from sliplab.storage.process import user_name
    from sliplab.storage.remote.mirror import open_store

    for name, given in (("--count", count is not None), ("--no-page", not page)):
        if given and not by_change:
            raise InputError(name, "", "", "goes with --next")
    opened = open_store(store)
    trials = TrialList(opened, campaign or ())

    def begin(address: str | None) -> None:
        waiting = sum(row.state in {"open", "stale"} for row in trials.rows)
        found = _ordered(trials) if by_change else None
        summary = {"trials": len(trials.rows), "to_decide": waiting}
        if as_json:
            order = {} if found is None else _order_json(trials, found, count or COUNT)
            url = {} if address is None else {"url": address}
            console.print_json({**url, **summary, **order})
            return
        if found is not None:
            _print_order(trials, found, count or COUNT)
        if address is not None:
            console.say(
                f"{plural(len(trials.rows), 'trial')}, {waiting} to review. Ctrl-C ends the page:"
            )
            console.show(address)

    if not page:
        begin(None)
        return
    from sliplab.flows.running import stopping
    from sliplab.plugins.web.pages import serving
    from sliplab.plugins.web.pages.access import Access
    from sliplab.plugins.web.pages.web import Web

    access = Access.temporary()
    web = Web(opened, access, reviews=trials, who=who or user_name())
    with closing(serving.listen(port)) as listener:
        port = listener.getsockname()[1]
        token = access.tokens["operator"]
        begin(f"http://{serving.HOST}:{port}/enter?token={token}&to=/review")
        serving.serve(web, listener)
    stopping.check()


def _ordered(trials: TrialList) -> ReviewOrder:
    """Order the trials by what a review would change, in the list, too."""
    from sliplab.plugins.web.review.order import review_order

    found = review_order(trials.store, list(trials.items.values()))
    trials.rank([item.name for item in found.trials])
    return found


def _order_json(trials: TrialList, found: ReviewOrder, count: int) -> dict[str, Any]:
    return {
        "simulated": trials.store.simulated,
        "in_doubt": len(found.trials),
        "next": [
            {
                "campaign": item.campaign,
                "trial": item.trial,
                "split": item.split,
                "spread_ms": item.doubt.spread_ms,
                "unusable": item.doubt.unusable,
                "score": item.score,
                "moves": item.moves,
                "reasons": item.doubt.reasons,
            }
            for item in found.trials[:count]
        ],
        "gains": found.gains(count),
        "notes": found.notes,
    }


def _print_order(trials: TrialList, found: ReviewOrder, count: int) -> None:
    """Print the first trials, and what their review does for the figure that labels blur most."""
    simulated = " (simulated)" if trials.store.simulated else ""
    for note in found.notes:
        console.say(note)
    if not found.trials:
        console.show(f"No label is in doubt: a review would change nothing{simulated}.")
        return
    first = found.trials[:count]
    columns = (
        "campaign",
        "trial",
        "part",
        "incipient sd (ms)",
        "gross sd (ms)",
        "may be lost",
        "would change",
        "because",
    )
    rows = [
        (
            item.campaign,
            item.trial,
            item.split,
            *(f"{spread:.0f}" for spread in item.doubt.spread_ms.values()),
            f"{item.doubt.unusable:.0%}",
            _moves(item),
            "; ".join(item.doubt.reasons),
        )
        for item in first
    ]
    title = (
        f"{len(first)} of {plural(len(found.trials), 'trial')} in doubt, by what a "
        "review would change"
    )
    console.print_table(title + simulated, columns, rows)
    gains = found.gains(count)
    if not gains:
        known = "no figure would change" if found.figures else "unknown without an evaluation"
        console.show(f"Gain of the figures: {known}{simulated}.")
        return
    best = gains[0]
    width, label, left = (
        _amount(value, best.unit) for value in (best.width, best.label_width, best.left)
    )
    done = "this review" if len(first) == 1 else f"these {len(first)} reviews"
    console.show(
        f"{best.experiment} {best.figure}{simulated}: 95 % interval over trials {width} wide; "
        f"labels alone leave {label} open, and at best {left} after {done} "
        f"({1 - best.left / best.label_width:.0%} less)."
    )


def _moves(item: Waiting) -> str:
    """Return the figure that a review would change most, and how many others it may change."""
    from sliplab.plugins.web.review.order import TRAINING

    if not item.moves:
        return "no figure"
    first, *others = item.moves
    share = "" if first.of_interval is None else f" ({first.of_interval:.1%} of its interval)"
    if first.figure == TRAINING:
        share = " of all"
    more = f", and {len(others)} more" if others else ""
    return f"{first.experiment} {first.figure} {_amount(first.change, first.unit)}{share}{more}"


def _amount(value: float, unit: str) -> str:
    return f"{value:.2f} ms" if unit == "ms" else f"{100 * value:.2f} %"
