"""Numbers of a fit of a simulated rig to a pilot, beside the rig file that it wrote."""

from __future__ import annotations

from typing import Literal

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part


class ParameterFit(Part):
    """One parameter of the scene.

    Attributes:
        key: in the section `mock:` of a rig file. assumed: the rig file's value.
        value: median; low, high: central 95 %. All of what the pilot leaves likely.
        least, most: of the worlds that were simulated first.
    """

    key: str
    title: str
    unit: str
    assumed: Number
    value: Number
    low: Number
    high: Number
    least: Number
    most: Number
    identified: Bool


class StatisticSeen(Part):
    """What was read of the fitted trials, and the middle 95 % of the worlds."""

    pilot: Number | None
    low: Number | None
    high: Number | None


class MisfitCheck(Part):
    """A check for one kind of effect that the scene lacks.

    Attributes:
        stream: that shows it. pilot: what was measured. limit: largest that the scene shows.
        share: of the twin's worlds that show as much.
        found: the pilot shows more than the scene can.
    """

    title: str
    stream: Literal["frames", "events", "poses", "force"]
    unit: str
    pilot: Number
    limit: Number
    share: Number
    found: Bool


class QuantityCompared(Part):
    """A quantity of the test trials.

    Attributes:
        title: with its unit. pilot: mean. twin, before: mean difference of the twin's worlds, and
            of worlds of the rig file as it was. scatter: of one trial between two worlds.
    """

    title: str
    pilot: Number
    twin: Number
    before: Number
    scatter: Number


class TwinFit(Document):
    """A fit of a simulated rig to a pilot.

    Attributes:
        simulated: the pilot itself was. checksum: of the fitted trials.
        trials: fitted; judged: test trials. worlds: simulated for the fit; predicted: of the twin.
    """

    simulated: Bool
    campaign: str
    rig: str
    checksum: str
    trials: Int
    judged: Int
    worlds: Int
    predicted: Int
    seconds: Number
    parameters: tuple[ParameterFit, ...]
    statistics: dict[str, StatisticSeen]
    checks: tuple[MisfitCheck, ...] = ()
    compared: tuple[QuantityCompared, ...] = ()
