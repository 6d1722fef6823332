"""Content of a publication: trials of a store with their splits, and the output folder.

A publication is written into a temporary sibling folder and appears by one rename: it is complete,
or it does not exist. The store is only read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.errors import StoreError
from sliplab.storage.files import make_folder, replacing
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore

LICENCES = (
    "CC0-1.0",
    "CC-BY-4.0",
    "CC-BY-SA-4.0",
    "CC-BY-NC-4.0",
    "CC-BY-NC-SA-4.0",
    "CC-BY-ND-4.0",
    "CC-BY-NC-ND-4.0",
    "ODbL-1.0",
    "ODC-By-1.0",
    "PDDL-1.0",
    "CDLA-Permissive-1.0",
    "CDLA-Permissive-2.0",
    "CDLA-Sharing-1.0",
    "C-UDA-1.0",
    "Apache-2.0",
    "BSD-3-Clause",
    "MIT",
)
"""Licences of data by their SPDX ids; any other one is ``LicenseRef-NAME``, as SPDX has it."""
_OWN_LICENCE = re.compile(r"LicenseRef-[A-Za-z0-9.-]+")
PERSONAL = ("operator", "host")
"""Keys of a trial's provenance that are not published."""
NO_SPLIT = "none"
SPLITS = {
    "train": "cr:TrainingSplit",
    "validation": "cr:ValidationSplit",
    "test": "cr:TestSplit",
    NO_SPLIT: None,
}
"""Parts of a split by their names in tables, with Croissant's names."""


@dataclass(frozen=True)
class PublicationInfo:
    """Metadata of a publication, from the publisher.

    Attributes:
        licence: an SPDX id; None if none was given.
        date: day of the publication, ISO 8601.
    """

    title: str
    creators: tuple[str, ...]
    licence: str | None
    date: str

    def __post_init__(self) -> None:
        """Check title, creators and licence."""
        if not self.title.strip() or "\n" in self.title:
            raise InputError("--title", "", self.title, "must be one line of text")
        for name in self.creators:
            if not name.strip() or "\n" in name:
                raise InputError("--creator", "", name, "must be a name")
        known = self.licence is None or self.licence in LICENCES
        if not known and not _OWN_LICENCE.fullmatch(str(self.licence)):
            raise InputError(
                "--licence",
                "",
                self.licence,
                f"must be one of {', '.join(LICENCES)}, or LicenseRef-NAME for another licence",
            )

    @property
    def licence_url(self) -> str | None:
        """Address of the licence's text; None without one, and for one that SPDX does not list."""
        if self.licence is None or self.licence not in LICENCES:
            return None
        return f"https://spdx.org/licenses/{self.licence}.html"


@dataclass(frozen=True)
class Publication:
    """Trials to be published.

    Attributes:
        splits: part of the split of each trial, by campaign and id; imported ones have none.
    """

    store: TrialStore
    campaigns: tuple[Campaign, ...]
    about: PublicationInfo
    splits: Mapping[tuple[str, str], str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check that there are trials, and that all of them have their files."""
        for campaign in self.campaigns:
            for trial, cause in sorted(campaign.damaged().items()):
                raise _damaged(campaign, trial, cause)
        if not self.count:
            raise InputError(
                self.store.folder,
                "campaigns",
                ", ".join(c.name for c in self.campaigns) or "none",
                "must have a committed trial to publish; run `sliplab collect` or `sliplab import`",
            )

    @property
    def count(self) -> int:
        """Number of trials."""
        return sum(len(campaign.committed()) for campaign in self.campaigns)

    @cached_property
    def recordings(self) -> tuple[tuple[Campaign, Recording], ...]:
        """Every trial with its campaign, by the names of both."""
        return tuple(
            (campaign, recording)
            for campaign in self.campaigns
            for recording in campaign.recordings()
        )

    def split(self, campaign: str, trial: str) -> str:
        """Return the part of the split that a trial is in."""
        return self.splits.get((campaign, trial), NO_SPLIT)

    @property
    def parts(self) -> tuple[str, ...]:
        """Parts of the split, `NO_SPLIT` only where a trial has none."""
        found = {self.split(where.name, trial.folder.name) for where, trial in self.recordings}
        return tuple(name for name in SPLITS if name != NO_SPLIT or name in found)

    @property
    def simulated(self) -> bool:
        """True if any trial is of a simulated rig."""
        return any(recording.simulated for _, recording in self.recordings)

    @cached_property
    def versions(self) -> dict[str, tuple[str, ...]]:
        """Versions of the programs that collected the trials, by program."""
        found: dict[str, set[str]] = {}
        for campaign, recording in self.recordings:
            for name, version in campaign.provenance(recording).versions.items():
                found.setdefault(name, set()).add(version)
        return {name: tuple(sorted(versions)) for name, versions in found.items()}

    @property
    def description(self) -> str:
        """The publication in two sentences; of simulated data, the first says so."""
        names = ", ".join(campaign.name for campaign in self.campaigns)
        simulated = "Simulated data. " if self.simulated else ""
        return (
            f"{simulated}{plural(self.count, 'trial')} of tactile slip (campaigns: {names}) "
            "with events, "
            "frames, arm poses and clocks on one time line. Recorded and published with SlipLab."
        )

    @property
    def citation(self) -> str:
        """A line by which the publication is cited."""
        people = ", ".join(self.about.creators) or "Unknown authors"
        simulated = " (simulated data)" if self.simulated else ""
        return f"{people} ({self.about.date[:4]}): {self.about.title}{simulated}. Data set."

    def files(self, campaign: Campaign, recording: Recording) -> dict[str, Path]:
        """Return the files of a trial by name, each checked against its checksum.

        Raises:
            InputError: the trial is damaged.
        """
        try:
            return recording.files()
        except StoreError as error:
            raise _damaged(campaign, recording.folder.name, str(error)) from None


def campaign_folder(campaign: str) -> str:
    """Return the path of a campaign's folder in a publication."""
    return f"campaigns/{campaign}"


def trial_folder(campaign: str, trial: str) -> str:
    """Return the path of a trial's folder in a publication that keeps a store's files."""
    return f"{campaign_folder(campaign)}/trials/{trial}"


TrialPath = Callable[[str, str], str]
"""Gives a trial's path in a publication from the names of its campaign and itself."""


def _damaged(campaign: Campaign, trial: str, cause: str) -> InputError:
    return InputError(
        campaign.folder.parents[1],
        f"campaigns.{campaign.name}.trials.{trial}",
        cause,
        "must be whole to be published; `sliplab verify STORE --quarantine` quarantines it",
    )


@contextmanager
def staged(output: Path) -> Iterator[Path]:
    """Make a sibling folder that is renamed to `output` when the block ends without an error.

    Raises:
        InputError: `output` exists.
    """
    if output.exists() or output.is_symlink():
        raise InputError(
            "--output", "", str(output), "exists; it is not overwritten: name a new folder"
        )
    make_folder(output.parent)
    with replacing(output) as folder:
        folder.mkdir()
        yield folder
