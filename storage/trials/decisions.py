"""What a person decided about a campaign's trials, and the undoing of it; nothing is deleted.

    campaigns/NAME/skipped.json           trials set aside by a person: who, when, why
    campaigns/NAME/quarantine/ID.N/cause.json   says who took a committed trial away again

Whoever calls what changes something here holds the store's lock.
"""

from __future__ import annotations

from collections.abc import Iterable

from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json, write_json
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import AGAIN, CAUSE, FORGIVEN, Campaign

SKIPPED = "skipped.json"


def skipped(campaign: Campaign) -> dict[str, Json]:
    """Trials that a person set aside: ``who``, ``when``, ``why`` by id.

    Raises:
        StoreError: the list is damaged.
    """
    path = campaign.folder / SKIPPED
    try:
        found = read_json(path)
        if not all(isinstance(by, dict) for by in found.values()):
            raise ValueError(f"{path}: does not say who set which trial aside")
        return found
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise StoreError(
            f"{error}; it is damaged: put it back from a copy, or delete it to take those trials "
            "after all (who asked for what is in control/)"
        ) from None


def skip(campaign: Campaign, trials: Iterable[str], by: Json) -> dict[str, str]:
    """Set trials aside, so that no collection takes them; what became of each, in words.

    Args:
        by: who, when and why.
    """
    there, known, did = campaign.committed(), skipped(campaign), {}
    for trial in trials:
        if trial in there:
            did[trial] = "is committed: left as it is"
        elif trial in known:
            did[trial] = "was set aside already"
        else:
            known[trial] = by
            did[trial] = "set aside"
    if "set aside" in did.values():
        write_json(campaign.folder / SKIPPED, known)
    return did


def again(campaign: Campaign, trials: Iterable[str], by: Json) -> dict[str, str]:
    """Make trials pending again; what became of each, in words.

    Committed ones go to quarantine, with who, when and why; those set aside, by a person or after
    too many retakes, are no longer.
    """
    there, known, did = campaign.committed(), skipped(campaign), {}
    before = len(known)
    for trial in trials:
        done = []
        if trial in there:
            folder = campaign.folder / "trials" / trial
            cause = f"{AGAIN}: {by.get('why') or 'no reason given'}"
            target = campaign.quarantine(folder, cause, asked=by)
            done.append(f"moved to quarantine/{target.name}")
        if known.pop(trial, None) is not None:
            done.append("no longer set aside")
        if count := _forgive(campaign, trial, by):
            done.append(f"{count} failed attempts count no longer")
        did[trial] = "; ".join([*done, "will be taken again"] if done else ["was pending already"])
    if len(known) < before:
        write_json(campaign.folder / SKIPPED, known)
    return did


def _forgive(campaign: Campaign, trial: str, by: Json) -> int:
    """Attempts that failed before now do not count any more towards the retakes."""
    count = 0
    for item in campaign.quarantined():
        if item["trial"] == trial and str(item["cause"]).startswith("gate"):
            path = campaign.folder / "quarantine" / item["folder"] / CAUSE
            if FORGIVEN not in item:
                write_json(path, {**read_json(path), FORGIVEN: by})
                count += 1
    return count
