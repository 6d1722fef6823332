"""`sliplab rates`."""

from __future__ import annotations

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console

app = typer.Typer()


@app.command(epilog="Example: sliplab rates my-store")
def rates(store: StoreArgument, names: CampaignOption = None, as_json: JsonOption = False) -> None:
    """Measure event rates before and in the motion of each trial."""
    from lab_rates.study import COLUMNS, RESULT, measure, rows
    from sliplab.analysis.campaigns import collected
    from sliplab.storage.trials.store import Store

    opened = Store.open(store)
    result = measure(opened, collected(opened, names))
    if as_json:
        console.print_json(result)
        return
    simulated = " (simulated)" if result["simulated"] else ""
    console.print_table(f"Event rates{simulated}", COLUMNS, rows(result))
    console.say(f"stored in {store / RESULT.file}; the next report shows them")
