"""Manifests: one small object that lists all files of a campaign or trial, and makes it visible.

    URL/sliplab.json                         version of this layout
    URL/campaigns/NAME/objects/SHA256        files by their content, written once, never changed
    URL/campaigns/NAME/about.json            manifest of campaign.json, protocol, rig file, bench,
                                             registrations
    URL/campaigns/NAME/trials/ID.json        manifest of a committed trial, written after its files
    URL/campaigns/NAME/quarantine/ID.N.json  manifest of a quarantined folder, if requested
    URL/campaigns/NAME/withdrawn/TAKE.json   mark: the recording TAKE of a trial is not wanted any
                                             more; without one, a missing manifest is a fault

A manifest comes from elsewhere and is not trusted: names are plain file names of the kinds that
belong there, and objects are found by their checksums, so that no path in it leads anywhere.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from sliplab.protocols.hashing import hash_data
from sliplab.storage.files import json_text, read_json, safe_name
from sliplab.storage.remote.objects import SMALL_BYTES, Remote, RemoteError, RemoteMissing
from sliplab.storage.schema.campaign_end import CHOICES, STOPPING
from sliplab.storage.trials.checksums import (
    CHECKSUMS,
    DATA,
    FRAMES,
    PROVENANCE,
    RECORD,
    SPOOL,
    Checksum,
    Checksums,
    as_json,
    is_stream_file,
    read_sums,
)
from sliplab.storage.trials.control import SKIPPED
from sliplab.storage.trials.registration import FILE
from sliplab.storage.trials.store import (
    CAUSE,
    INFO,
    PROTOCOL,
    REGISTRATIONS,
    RIG,
    Campaign,
    StoreError,
)

Kind = Literal["about", "trials", "quarantine", "withdrawn"]
FORMAT = 1
NEEDED: Mapping[Kind, frozenset[str]] = {
    "about": frozenset({INFO, PROTOCOL, RIG, CHECKSUMS}),
    "trials": frozenset({DATA, RECORD, CHECKSUMS, PROVENANCE}),
    "quarantine": frozenset({CAUSE}),
    "withdrawn": frozenset(),
}
ALLOWED: Mapping[Kind, frozenset[str]] = {
    "about": NEEDED["about"] | {SKIPPED, CHOICES, STOPPING},
    "trials": NEEDED["trials"] | {FRAMES},
    "quarantine": NEEDED["trials"] | {FRAMES, CAUSE, SPOOL},
    "withdrawn": frozenset(),
}
_NUMBERED = re.compile(rf"bench/\d{{4,8}}\.json|{REGISTRATIONS}/{FILE.pattern}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
_MOST_FILES = 10_000
_SUMS_BYTES = 1 << 16
"""Limit of a trial's checksums."""


@dataclass(frozen=True)
class Manifest:
    """All files of a campaign's description, a trial, or a quarantined folder.

    Attributes:
        name: the folder's; empty for a description; the take of a withdrawn trial.
        files: checksums by path below the folder.
        take: hash of the checksums of raw data and record; empty if there are none.
    """

    kind: Kind
    campaign: str
    name: str
    files: Checksums
    take: str = ""

    @property
    def key(self) -> str:
        """Key of this manifest."""
        return manifest_key(self.kind, self.campaign, self.name)

    def object_key(self, file: str) -> str:
        """Return the key of one of its files."""
        return f"{objects_folder(self.campaign)}/{self.files[file].sha256}"

    def dump(self) -> bytes:
        """Return it as an object; equal manifests are equal bytes."""
        data = {"format": FORMAT, **vars(self), "files": as_json(self.files)}
        return json_text({**data, "sum": hash_data(data)}).encode()


def manifest_key(kind: Kind, campaign: str, name: str = "") -> str:
    """Return the key of a manifest."""
    folder = f"campaigns/{safe_name(campaign)}/{kind}"
    return f"{folder}/{safe_name(name)}.json" if name else f"{folder}.json"


def objects_folder(campaign: str) -> str:
    """Return the folder of a campaign's files."""
    return f"campaigns/{safe_name(campaign)}/objects"


def parse(data: bytes, kind: Kind, campaign: str, name: str, where: str) -> Manifest:
    """Check a manifest that was read from `where`.

    Raises:
        RemoteError: it is damaged, of a newer version, of something else, or names a file that
            does not belong there.
    """
    try:
        found = json.loads(data)
        given = found.pop("sum")
        sealed = given == hash_data(found)
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise RemoteError(f"{where}: is not a manifest, or is incomplete") from None
    if isinstance(found.get("format"), int) and found["format"] > FORMAT:
        raise RemoteError(
            f"{where}: format = {found['format']}: was pushed by a newer version of SlipLab; "
            f"this one reads formats up to {FORMAT}: update it"
        )
    if not sealed:
        raise RemoteError(f"{where}: is damaged: its contents do not match its checksum")
    if (found.get("kind"), found.get("campaign"), found.get("name")) != (kind, campaign, name):
        raise RemoteError(f"{where}: belongs to another trial or campaign")
    files, take = found.get("files"), found.get("take")
    if not isinstance(files, dict) or not isinstance(take, str) or len(files) > _MOST_FILES:
        raise RemoteError(f"{where}: lists no files")
    sums: Checksums = {}
    for path, item in files.items():
        if not _allowed(path, kind):
            raise RemoteError(f"{where}: names the file '{path}', which does not belong there")
        known = Checksum.parse(item)
        if known is None or not _SHA256.fullmatch(known.sha256) or known.bytes < 0:
            raise RemoteError(f"{where}: has no checksum of {path}")
        sums[path] = known
    if missing := NEEDED[kind] - files.keys():
        raise RemoteError(f"{where}: lacks {', '.join(sorted(missing))}")
    return Manifest(kind, campaign, name, sums, take)


def _allowed(path: str, kind: Kind) -> bool:
    """Return whether a file of this name may be in a manifest of a kind."""
    further = is_stream_file(path)
    if kind == "about":
        further = _NUMBERED.fullmatch(path) is not None
    return path in ALLOWED[kind] or (further and kind != "withdrawn")


def read_manifests(
    remote: Remote, campaign: str, kind: Kind, only: str = ""
) -> dict[str, Manifest | RemoteError]:
    """Read every manifest of a kind, by its name; an error represents a bad one.

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
        if isinstance(data, RemoteMissing):
            continue
        name = keys[key]
        try:
            if isinstance(data, RemoteError):
                raise data
            found[name] = parse(data, kind, campaign, name, remote.where(key))
        except RemoteError as error:
            found[name] = error
    return found


def listing_problem(
    remote: Remote,
    campaign: str,
    about: Manifest | RemoteError | None,
    trials: Mapping[str, Manifest | RemoteError],
) -> str | None:
    """Return why the list of a campaign's trials cannot be complete; None if it can be.

    Every file that was pushed belongs to a manifest; a campaign whose files are there without any
    trial has lost its manifests, or its folder cannot be read completely at the moment.
    """
    if about is None and trials:
        return f"{remote.where(manifest_key('about', campaign))}: is missing"
    if trials:
        return None
    listed = [about, *read_manifests(remote, campaign, "quarantine").values()]
    known = {
        item.sha256
        for found in listed
        if isinstance(found, Manifest)
        for item in found.files.values()
    }
    sizes = remote.sizes(objects_folder(campaign))
    unknown = {sha: size for sha, size in sizes.items() if sha not in known}
    marked = read_manifests(remote, campaign, "withdrawn")
    if not unknown or (marked and _takes(remote, campaign, unknown) <= marked.keys()):
        return None
    return (
        f"{remote.url}/campaigns/{campaign}/trials: is empty or missing, although files of trials "
        "are there: a push has not ended, or the folder cannot be read at the moment; try again, "
        "and if it stays so, push the store again"
    )


def _takes(remote: Remote, campaign: str, sizes: Mapping[str, int]) -> set[str]:
    """Return the takes whose checksums are among some objects of a campaign."""
    folder = objects_folder(campaign)
    small = [f"{folder}/{sha}" for sha, size in sizes.items() if size <= _SUMS_BYTES]
    takes = set()
    for data in remote.read_many(small).values():
        try:
            sums = json.loads(b"" if isinstance(data, RemoteError) else data)
        except (ValueError, RecursionError):
            continue
        if isinstance(sums, dict) and all(map(Checksum.parse, sums.values())) and DATA in sums:
            takes.add(hash_data(sums))
    return takes


def campaign_manifest(campaign: Campaign) -> Manifest:
    """Make the manifest of a campaign's description as it is on disk.

    Raises:
        ValueError: it is just being written, or damaged; the message names the file.
    """
    folder = campaign.folder
    sums = read_sums(folder, (PROTOCOL, RIG, INFO))
    files = {name: sums[name] for name in (PROTOCOL, RIG, INFO)}
    more = [CHECKSUMS]
    more += [name for name in (SKIPPED, CHOICES, STOPPING) if (folder / name).exists()]
    for below in ("bench", REGISTRATIONS):
        found = sorted(f"{below}/{path.name}" for path in (folder / below).glob("*"))
        more += filter(_NUMBERED.fullmatch, found)
    return Manifest("about", campaign.name, "", files | _measured(folder, more))


def trial_manifest(campaign: Campaign, trial_id: str) -> Manifest:
    """Make the manifest of a committed trial from its checksums; its big files are not read.

    Raises:
        ValueError: its checksums are missing or damaged.
        OSError: it disappeared in the meantime.
    """
    folder = campaign.folder / "trials" / safe_name(trial_id)
    files = read_sums(folder) | _measured(folder, (CHECKSUMS, PROVENANCE))
    return Manifest("trials", campaign.name, trial_id, files, take_of(folder))


def quarantine_manifest(campaign: Campaign, name: str) -> Manifest:
    """Make the manifest of a quarantined folder; all of it is read.

    Raises:
        OSError: it cannot be read, or lacks its cause.
    """
    folder = campaign.folder / "quarantine" / safe_name(name)
    found = {path.name for path in folder.iterdir() if path.is_file()}
    names = {file for file in found if _allowed(file, "quarantine")} | {CAUSE}
    return Manifest("quarantine", campaign.name, name, _measured(folder, sorted(names)))


def take_of(folder: Path) -> str:
    """Return the hash of the checksums in a trial's folder; empty without checksums."""
    try:
        return hash_data(read_json(folder / CHECKSUMS))
    except (OSError, ValueError):
        return ""


def check_against_sums(manifest: Manifest, sums: Any, where: str) -> None:
    """Check that a trial's manifest has the checksums that the trial itself has.

    Args:
        sums: the content of the trial's `checksums.json`.

    Raises:
        RemoteError: it has others.
    """
    apart = {CHECKSUMS, PROVENANCE}
    stated = {name: known for name, known in manifest.files.items() if name not in apart}
    try:
        own = {name: Checksum.parse(item) for name, item in sums.items()}
        same = stated == own and manifest.take == hash_data(sums)
    except (AttributeError, TypeError, ValueError):
        same = False
    if not same:
        raise RemoteError(f"{where}: is not what the trial's {CHECKSUMS} says")


def _measured(folder: Path, names: Sequence[str]) -> Checksums:
    for name in names:
        if (folder / name).is_symlink():
            raise StoreError(f"{folder / name}: is a link, links are not pushed")
    return {name: Checksum.of(folder / name) for name in names}
