"""Recovery of trials whose program was killed while it committed them.

A trial is complete when its record is written: the data are on the disk before, and only checksums
and the rename are left to do. A recording without a record was not finished.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from sliplab.storage.errors import own_fault
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.trial import TrialRecord
from sliplab.storage.trials.checksums import CHECKSUMS, ELSEWHERE, RECORD, read_sums
from sliplab.storage.trials.prefix_journal import drop_journal
from sliplab.storage.trials.store import CAUSE, Campaign
from sliplab.storage.trials.verify import content_problems, verify_trial
from sliplab.storage.trials.writer import finish_folder, make_visible, protect_folder


def recover(campaign: Campaign) -> list[str]:
    """Commit the complete trials among the unfinished ones; the caller holds the store's lock.

    Returns:
        Their ids.
    """
    folder = campaign.folder / "incoming"
    return [path.name for path in sorted(folder.iterdir()) if _commit(campaign, path)]


@uninterrupted
def _commit(campaign: Campaign, folder: Path) -> bool:
    """Commit one folder if it is a complete trial."""
    target = campaign.folder / "trials" / folder.name
    if folder.is_symlink() or target.exists() or not (folder / RECORD).is_file():
        return False
    if (folder / CAUSE).exists() or (folder / ELSEWHERE).exists():
        return False
    drop_journal(folder)
    if not _has_checksums(folder):
        if _problems(lambda: content_problems(folder, TrialRecord.load(folder / RECORD))):
            return False
        finish_folder(folder)
    if _problems(lambda: verify_trial(folder)):
        return False
    protect_folder(folder)  # a kill may have come right before that
    make_visible(folder, target)
    return True


def _problems(check: Callable[[], Sequence[object]]) -> bool:
    """Return whether files fail a check, or cannot be read."""
    try:
        return bool(check())
    except (OSError, ValueError, KeyError, TypeError, RuntimeError) as error:
        if own_fault(error):
            raise
        return True


def _has_checksums(folder: Path) -> bool:
    """Return False where checksums are missing, or were written in part."""
    try:
        read_sums(folder)
    except ValueError:
        (folder / CHECKSUMS).unlink(missing_ok=True)
        return False
    return True
