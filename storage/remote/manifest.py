"""What makes a pushed campaign or trial visible: one small object that lists all of its files.

    URL/sliplab.json                         which layout this is
    URL/campaigns/NAME/objects/SHA256        files by their content, put once and never changed
    URL/campaigns/NAME/about.json            manifest of campaign.json, protocol, rig file, bench
    URL/campaigns/NAME/trials/ID.json        manifest of a committed trial, put after its files
    URL/campaigns/NAME/quarantine/ID.N.json  manifest of what was set aside, where asked for

A manifest comes from elsewhere and is believed in nothing: names are plain file names of the kinds
that belong there, objects are found by their checksums, so no path in it leads anywhere.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sliplab.protocols.hashing import hash_data
from sliplab.storage.fetching import objects_folder
from sliplab.storage.files import json_text, read_json, safe_name, sha256
from sliplab.storage.objects import SMALL_BYTES, Remote, RemoteError, RemoteMissing
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import read_sums
from sliplab.storage.trials.decisions import SKIPPED
from sliplab.storage.trials.store import CAUSE, INFO, PROTOCOL, RIG, Campaign, StoreError
from sliplab.storage.trials.writer import CHECKSUMS, DATA, FRAMES, PROVENANCE, RECORD, SPOOL

Kind = Literal["about", "trials", "quarantine"]
FORMAT = 1
NEEDED: Mapping[Kind, frozenset[str]] = {
    "about": frozenset({INFO, PROTOCOL, RIG, CHECKSUMS}),
    "trials": frozenset({DATA, RECORD, CHECKSUMS, PROVENANCE}),
    "quarantine": frozenset({CAUSE}),
}
ALLOWED: Mapping[Kind, frozenset[str]] = {
    "about": NEEDED["about"] | {SKIPPED},
    "trials": NEEDED["trials"] | {FRAMES},
    "quarantine": NEEDED["trials"] | {FRAMES, CAUSE, SPOOL},
}
_BENCH = re.compile(r"bench/\d{4,8}\.json")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MOST_FILES = 10_000


@dataclass(frozen=True)
class Manifest:
    """All files of a campaign's description, a trial, or something in quarantine.

    Attributes:
        name: the folder's; empty for a description.
        files: ``sha256`` and ``bytes`` by path below the folder.
        take: stands for the raw data and the record; empty where there are no checksums.
    """

    kind: Kind
    campaign: str
    name: str
    files: Json
    take: str = ""

    @property
    def key(self) -> str:
        """Where it stands below the URL."""
        return manifest_key(self.kind, self.campaign, self.name)

    def object_key(self, file: str) -> str:
        """Where one of its files stands below the URL."""
        return f"{objects_folder(self.campaign)}/{self.files[file]['sha256']}"

    def dump(self) -> bytes:
        """As an object; equal manifests are equal bytes."""
        data = {"format": FORMAT, **vars(self)}
        return json_text({**data, "sum": hash_data(data)}).encode()


def manifest_key(kind: Kind, campaign: str, name: str = "") -> str:
    """Where a manifest stands below the URL."""
    folder = f"campaigns/{safe_name(campaign)}/{kind}"
    return f"{folder}/{safe_name(name)}.json" if name else f"{folder}.json"


def parse(data: bytes, kind: Kind, campaign: str, name: str, where: str) -> Manifest:
    """A manifest that was read from `where`.

    Raises:
        RemoteError: it is damaged, of a newer version, of something else, or names a file that
            does not belong there.
    """
    try:
        found = json.loads(data)
        said = found.pop("sum")
        sealed = said == hash_data(found)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise RemoteError(f"{where}: is no manifest, or only part of one") from None
    if isinstance(found.get("format"), int) and found["format"] > FORMAT:
        raise RemoteError(
            f"{where}: format = {found['format']}: was pushed by a newer version of SlipLab; "
            f"this one reads formats up to {FORMAT}: update it"
        )
    if not sealed:
        raise RemoteError(f"{where}: is damaged: its contents do not match its sum")
    if (found.get("kind"), found.get("campaign"), found.get("name")) != (kind, campaign, name):
        raise RemoteError(f"{where}: is of something else")
    files, take = found.get("files"), found.get("take")
    if not isinstance(files, dict) or not isinstance(take, str) or len(files) > _MOST_FILES:
        raise RemoteError(f"{where}: lists no files")
    for path, known in files.items():
        if not _belongs(kind, path):
            raise RemoteError(f"{where}: names the file '{path}', which does not belong there")
        if not _plain(known):
            raise RemoteError(f"{where}: has no checksum of {path}")
    if missing := NEEDED[kind] - files.keys():
        raise RemoteError(f"{where}: lacks {', '.join(sorted(missing))}")
    return Manifest(kind, campaign, name, files, take)


def _belongs(kind: Kind, path: str) -> bool:
    return path in ALLOWED[kind] or (kind == "about" and _BENCH.fullmatch(path) is not None)


def _plain(known: Any) -> bool:
    return (
        isinstance(known, dict)
        and isinstance(known.get("sha256"), str)
        and _SHA256.fullmatch(known["sha256"]) is not None
        and type(known.get("bytes")) is int
        and known["bytes"] >= 0
    )


def read_manifests(
    remote: Remote, campaign: str, kind: Kind, only: str = ""
) -> dict[str, Manifest | RemoteError]:
    """Every manifest of a kind by its name; what is wrong with it in place of one that is.

    Args:
        only: the one of this name.
    """
    if kind == "about" or only:
        names = [only]
    else:
        folder = manifest_key(kind, campaign).removesuffix(".json")
        names = [
            name.removesuffix(".json")
            for name, size in sorted(remote.sizes(folder).items())
            if name.endswith(".json") and not name.startswith(".") and size <= SMALL_BYTES
        ]
    found: dict[str, Manifest | RemoteError] = {}
    keys: dict[str, str] = {}
    for name in names:
        try:
            keys[manifest_key(kind, campaign, name)] = name
        except StoreError as error:
            found[name] = RemoteError(f"{remote.url}: campaign {campaign}: {error}")
    for key, data in remote.read_many(list(keys)).items():
        name = keys[key]
        if isinstance(data, RemoteMissing):
            continue
        try:
            if isinstance(data, RemoteError):
                raise data
            found[name] = parse(data, kind, campaign, name, remote.where(key))
        except RemoteError as error:
            found[name] = error
    return found


def of_campaign(campaign: Campaign) -> Manifest:
    """The manifest of a campaign's description as it is on disk.

    Raises:
        ValueError: it is just being written, or damaged; the message names the file.
    """
    folder = campaign.folder
    sums = read_sums(folder, (PROTOCOL, RIG, INFO))
    files = {name: sums[name] for name in (PROTOCOL, RIG, INFO)}
    more = [CHECKSUMS, *([SKIPPED] if (folder / SKIPPED).exists() else [])]
    more += sorted(
        f"bench/{path.name}"
        for path in (folder / "bench").glob("*.json")
        if _BENCH.fullmatch(f"bench/{path.name}")
    )
    files |= {name: _measured(folder / name) for name in more}
    return Manifest("about", campaign.name, "", files)


def of_trial(campaign: Campaign, trial_id: str) -> Manifest:
    """The manifest of a committed trial, by its checksums; its big files are not read.

    Raises:
        ValueError: its checksums are missing or damaged.
        OSError: it went away meanwhile.
    """
    folder = campaign.folder / "trials" / safe_name(trial_id)
    sums = read_sums(folder)
    files = {name: {key: sums[name][key] for key in ("sha256", "bytes")} for name in sums}
    files |= {name: _measured(folder / name) for name in (CHECKSUMS, PROVENANCE)}
    return Manifest("trials", campaign.name, trial_id, files, take_of(folder))


def of_quarantined(campaign: Campaign, name: str) -> Manifest:
    """The manifest of something in quarantine, all of it read.

    Raises:
        OSError: it cannot be read, or lacks its cause.
    """
    folder = campaign.folder / "quarantine" / safe_name(name)
    files = {
        file: _measured(folder / file)
        for file in sorted(ALLOWED["quarantine"])
        if (folder / file).is_file() or file == CAUSE
    }
    return Manifest("quarantine", campaign.name, name, files)


def take_of(folder: Path) -> str:
    """What stands for the raw data and record of a trial's folder; empty without checksums."""
    try:
        return hash_data(read_json(folder / CHECKSUMS))
    except (OSError, ValueError):
        return ""


def check_against_sums(manifest: Manifest, sums: Json, where: str) -> None:
    """A trial's manifest must say what the trial's own checksums say.

    Raises:
        RemoteError: it does not.
    """
    told = {
        name: known for name, known in manifest.files.items() if name not in {CHECKSUMS, PROVENANCE}
    }
    try:
        same = told == {
            name: {key: sums[name][key] for key in ("sha256", "bytes")} for name in sums
        } and manifest.take == hash_data(sums)
    except (KeyError, TypeError, ValueError):
        same = False
    if not same:
        raise RemoteError(f"{where}: is not what the trial's {CHECKSUMS} says")


def _measured(path: Path) -> Json:
    if path.is_symlink():
        raise StoreError(f"{path}: is a link, which is not pushed")
    return {"sha256": sha256(path), "bytes": path.stat().st_size}
