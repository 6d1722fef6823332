"""False alarms an hour that a network's accuracy costs, in quiet holding and under nuisances."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.trials import item_trials, quiet_alarms
from sliplab.analysis.metrics.alarm_rates import few_words
from sliplab.analysis.report.page import number, with_interval
from sliplab.protocols.plugin import plugins
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import AlarmRate, TrialScore
from sliplab.storage.streams import Json

COMMAND = "sliplab stress"
OWN = "own"
"""Title of the store's own network."""
QUIET, UNDISTURBED, DISTURBED = "quiet", "none", "nuisances"


def false_alarms(
    campaigns: Sequence[Collected],
    rows: Iterable[TrialScore],
    programs: Mapping[str, Json],
    network: str,
) -> dict[str, Json]:
    """Return all rates of a network that are known, as plain data; see `NetworkWindows`.

    Args:
        programs: results of further commands, by name; plug-ins read rates from them.
        network: its title in them.
    """
    quiet = quiet_alarms(item_trials(campaigns, rows))
    found = {} if quiet is None else {QUIET: quiet}
    for alarms in plugins().hooks("false_alarms"):
        found |= alarms(programs, network)
    return {name: rate.to_json() for name, rate in found.items()}


def rate_words(rate: AlarmRate | None) -> str:
    """Return a rate with its interval; a dash for none."""
    if rate is None:
        return number(None)
    span = None if rate.low is None or rate.high is None else (rate.low, rate.high)
    return with_interval(rate.value, span, 1 if rate.value < 100 else 0)


def alarm_words(found: dict[str, AlarmRate]) -> str:
    """Return the cost of accuracy in false alarms, as a sentence."""
    quiet, disturbed = found.get(QUIET), found.get(DISTURBED)
    text = "False alarms an hour (95 %, over trials): "
    if quiet is None:
        text += "not known in quiet holding, "
    else:
        text += (
            f"{rate_words(quiet)} in quiet holding ({quiet.alarms} in {quiet.hours:.3f} h of "
            f"{plural(quiet.clusters, 'trial')}), "
        )
        if few := few_words(quiet.clusters):
            text = text.removesuffix("), ") + f"; {few}), "
    if disturbed is None:
        return text + f"not measured under nuisances ({COMMAND})"
    text += f"{rate_words(disturbed)} under nuisances"
    if (still := found.get(UNDISTURBED)) is not None:
        text += f", {rate_words(still)} in the same trials without one"
    return text
