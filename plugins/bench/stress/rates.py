"""False alarms an hour under nuisances, for the report's accuracy."""

from __future__ import annotations

from collections.abc import Mapping

from sliplab.analysis.report.alarms import DISTURBED, UNDISTURBED
from sliplab.analysis.report.programs import STRESS
from sliplab.plugins.bench.stress.document import ALL, StressRecord
from sliplab.storage.schema.evaluation import AlarmRate
from sliplab.storage.streams import Json


def report_alarms(programs: Mapping[str, Json], network: str) -> dict[str, AlarmRate]:
    """Return the rates of a network in a report's further results.

    Raises:
        StoreError: the file is of another shape.
    """
    if "stress" not in programs:
        return {}
    return stress_alarms(STRESS.parse(StressRecord, programs["stress"]), network)


def stress_alarms(record: StressRecord | None, network: str) -> dict[str, AlarmRate]:
    """Return the rates that `sliplab stress` measured of a network with its rule.

    Args:
        network: its title in the record.
    """
    ours = () if record is None else record.detectors
    rule = next((it for it in ours if it.network == network and it.is_rule), None)
    found = {}
    for figures in () if rule is None else rule.figures:
        name = {ALL: DISTURBED, "none": UNDISTURBED}.get(figures.nuisance)
        if name is not None and figures.strength is None:
            rate = figures.per_hour
            found[name] = AlarmRate(
                alarms=figures.false_alarms,
                hours=figures.hold_h,
                value=rate.value,
                low=rate.low,
                high=rate.high,
                clusters=figures.trials,
            )
    return found
