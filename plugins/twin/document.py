"""Numbers of a fit of a simulated rig to a pilot, stored next to the rig file that it wrote."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from sliplab.storage.schema.document import Bool, Document, Int, Number, Part
from sliplab.storage.schema.evaluation import Experiments
from sliplab.storage.schema.holdout import HoldoutScores


class ParameterFit(Part):
    """One parameter of the scene.

    Attributes:
        key: in the section `mock:` of a rig file. assumed: the rig file's value.
        value: median; low, high: central 95 %. All of what the pilot leaves likely.
        least, most: of the worlds that were simulated first.
        withheld: misfits that touch the parameter; its interval is None then.
    """

    key: str
    title: str
    unit: str
    assumed: Number
    value: Number
    low: Number | None
    high: Number | None
    least: Number
    most: Number
    identified: Bool
    withheld: tuple[str, ...] = ()


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
        touches: keys of parameters whose intervals do not hold with such an effect.
    """

    title: str
    stream: Literal["frames", "events", "poses", "force"]
    unit: str
    pilot: Number
    limit: Number
    share: Number
    found: Bool
    touches: tuple[str, ...] = ()


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


Verdict = Literal["asked for", "not asked for", "not shown", "not in the scene"]


class EffectNeed(Part):
    """An effect of the scene, and how much worse test trials are predicted without it.

    Attributes:
        loss: mean of the score without the effect less that with it, in units of the twin's own
            scatter; low, high: its 90 % interval over trials. None where it was not measured.
        limit: largest loss by chance where the effect is not there.
        shown_by: numbers in which it shows most, or other trials that would show it.
        time: of a slide without the effect over that with it.
        left_out: of the cheapest scene.
    """

    title: str
    verdict: Verdict
    shown_by: str = ""
    loss: Number | None = None
    low: Number | None = None
    high: Number | None = None
    limit: Number | None = None
    time: Number | None = None
    left_out: Bool = False


class CheapestScene(Part):
    """The cheapest scene that predicts the test trials as well as the twin.

    Attributes:
        loss: of all that it leaves out together; low, high: its 90 % interval over trials.
        seconds: processor time of a slide. time: over that of the twin.
    """

    loss: Number
    low: Number
    high: Number
    seconds: Number
    time: Number


class TwinFit(Document):
    """A fit of a simulated rig to a pilot.

    Attributes:
        simulated: the pilot itself was. checksum: of the fitted trials.
        trials: fitted; judged: test trials. worlds: simulated for the fit; predicted: of the twin.
        needs: none where there are too few test trials. cheapest: None where nothing that saves
            time can be left out.
        gain_error: largest error of the force sensor's gain that intervals allow for, a share; None
            without forces.
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
    needs: tuple[EffectNeed, ...] = ()
    cheapest: CheapestScene | None = None
    gain_error: Number | None = None

    @property
    def misfits(self) -> list[MisfitCheck]:
        """Effects that the pilot shows, and the scene lacks."""
        return [check for check in self.checks if check.found]


TrainedOn = Literal["own", "twin", "drawn", "assumed"]
TITLES: Mapping[TrainedOn, str] = {
    "own": "the tested rig's own trials",
    "twin": "the twin",
    "drawn": "rigs drawn from the twin's posterior",
    "assumed": "the rig file as it was",
}


class Behind(Part):
    """Strict accuracy of the first network less that of another, 0 to 1.

    Attributes:
        low, high: 95 %, over the same trials; null with fewer than two.
    """

    share: Number | None
    low: Number | None
    high: Number | None


class GapNetwork(Part):
    """A network that was tested on a real rig's test trials.

    Attributes:
        rig: that its training trials were taken on; of several drawn ones, what these change.
        simulated: these trials were. rigs: their number. trials: that trained and chose it.
        validation: strict accuracy on its own validation windows, those of its own rig.
        windows: of the tested trials. f1: mean over classes.
        behind: of the first network; null for that.
    """

    trained_on: TrainedOn
    rig: str
    simulated: Bool
    rigs: Int
    trials: Int
    validation: Number | None
    windows: HoldoutScores
    f1: Number | None
    experiments: Experiments
    behind: Behind | None

    @property
    def title(self) -> str:
        """What it was trained on, for people."""
        title = TITLES[self.trained_on]
        if self.rigs > 1:
            title = f"{self.rigs} {title}"
        return f"{title} (simulated)" if self.simulated else title


class TwinGap(Document):
    """Networks trained on a twin's simulated trials, tested on those of the rig that it imitates.

    Attributes:
        simulated: the tested trials are. campaigns: with these. trials: tested.
        rig: the twin. protocol: of the trials that train.
        networks: own (only where the store has one), twin, drawn, assumed.
    """

    simulated: Bool
    campaigns: tuple[str, ...]
    trials: Int
    rig: str
    protocol: str
    networks: tuple[GapNetwork, ...]
