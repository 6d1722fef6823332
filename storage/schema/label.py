"""The label of a trial: its onsets by both rules, reasons for doubt, and tracking quality.

Times are integer nanoseconds on the trial's time line. The arrays next to it hold the markers'
places and displacements.
"""

from __future__ import annotations

from typing import Literal

from sliplab.storage.schema.document import Document, Int, Number, Part

LABELS = "labels"
"""The step's name in stores."""
Kind = Literal["incipient", "gross"]
KINDS: tuple[Kind, ...] = ("incipient", "gross")
Rule = Literal["paper", "change_point", "force", "given"]
"""`given`: the onsets came with the recording."""
RULES: tuple[Rule, ...] = ("paper", "change_point", "force")


class OnsetDoubts(Part):
    """Reason why an onset is ambiguous although a rule gives one, as text; null where known."""

    incipient: str | None = None
    gross: str | None = None

    def of(self, kind: Kind) -> str | None:
        """Return the doubt of one onset."""
        return self.incipient if kind == "incipient" else self.gross


class RuleOnsets(Part):
    """Onsets by one rule."""

    incipient_ns: Int | None
    """First slip of any marker; null where none slipped."""
    gross_ns: Int | None
    """Slip of the centre marker; null where it did not slip."""
    first_marker: Int | None = None
    """Index of the marker that slipped first."""
    per_marker_ns: tuple[Int, ...] = ()
    """Slip of each marker, -1 for none."""
    doubts: OnsetDoubts = OnsetDoubts()

    def at_ns(self, kind: Kind) -> int | None:
        """Return one onset, doubted or not."""
        return self.incipient_ns if kind == "incipient" else self.gross_ns

    def known_ns(self, kind: Kind) -> int | None:
        """Return one onset, None where it is in doubt."""
        return None if self.doubts.of(kind) is not None else self.at_ns(kind)


class ChangePoints(RuleOnsets):
    """Onsets by the change points of the markers' tracks, with the central 95 % of each slip."""

    low_ns: tuple[Int, ...] = ()
    high_ns: tuple[Int, ...] = ()


class OnsetIntervals(Part):
    """Central 95 % of the onsets by the paper's rule; null where there is none."""

    incipient_ns: tuple[Int, Int] | None
    gross_ns: tuple[Int, Int] | None


class ClassSpan(Part):
    """Part of a recording that shows one class."""

    start_ns: Int
    end_ns: Int
    name: str


class TrialLabel(RuleOnsets, Document):
    """The label of one trial.

    Its own onsets are those of the rule that the protocol names, null where they are in doubt.
    """

    key: str = ""
    """Of what made it: the trial, its clocks, settings and version."""
    end_ns: Int
    """End of the slip: the plate came to rest after gross onset, or the motion ended."""
    rule: Rule = "paper"
    """Rule whose onsets are used."""
    reference: Literal["hold_start", "hold_end"] | None = None
    """The end of the hold from which displacements count by the paper's rule; null in older labels,
    which count from its end."""
    paper: RuleOnsets | None = None
    """By the paper's rule, from that end."""
    references: dict[str, RuleOnsets] | None = None
    """By the paper's rule, from either end of the hold; null in older labels."""
    change_point: ChangePoints | None = None
    force: RuleOnsets | None = None
    """By the force along the plate; written only for trials that have forces."""
    hold_slip_px: tuple[Number | None, ...] = ()
    """Displacement of each marker in the hold; null where unknown."""
    markers_lost: Int = 0
    """Marker-frames without a measurement."""
    plate_lost: Int = 0
    """Frames in which the plate's marker was not seen."""
    camera_moved_px: Number | None = None
    """Largest shift of the camera."""
    flags: tuple[str, ...] = ()
    """Warnings that a reviewer should check first, as text."""
    quality: tuple[Number, ...] = ()
    """Each marker's lowest quality from the motion's start to its slip, 0 to 1."""
    source: str | None = None
    """`video`, `tracks` that the camera provided, `events` of a trial without frames, or `given`
    with the recording."""
    intervals: OnsetIntervals | None = None
    """Of the paper's rule, or of given onsets; written only for labels from events and given
    ones."""
    spans: tuple[ClassSpan, ...] = ()
    """Classes other than those of slip; written only where the recording came with them."""

    def by_rule(self, rule: Rule) -> RuleOnsets:
        """Return the onsets of one rule.

        Raises:
            ValueError: the label is older than the rule, or the trial has no forces.
        """
        rules = {"paper": self.paper, "change_point": self.change_point, "force": self.force}
        found = self if rule == self.rule == "given" else rules.get(rule)
        if found is None and rule == "force":
            raise ValueError("force: is missing; the trial has no forces, or run `sliplab label`")
        if found is None:
            raise ValueError(f"{rule}: is missing; run `sliplab label`")
        return found
