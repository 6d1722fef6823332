"""Registrations of a campaign: numbered files that are never changed, and stamps of them.

    campaigns/NAME/registrations/0001.json        what was registered, and when
    campaigns/NAME/registrations/0001.json.tsr    time stamp by RFC 3161; .ots by OpenTimestamps

Each file has a checksum of its content and the SHA-256 of the file before it. These show
damage; only a stamp or a signature of a third party shows when the file was made.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_data
from sliplab.storage.errors import StoreError, own_fault
from sliplab.storage.files import (
    is_temporary,
    json_text,
    make_folder,
    protect,
    read_json,
    read_plain,
    sha256,
    write_bytes,
    write_new_bytes,
)
from sliplab.storage.schema.registration import Registration
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import REGISTRATIONS, Campaign

STAMPS = (".tsr", ".ots")
"""Endings of stamps: responses of RFC 3161, and proofs of OpenTimestamps."""
FILE = re.compile(r"(?P<file>(?P<number>\d{4,8})\.json)(?P<stamp>\.tsr|\.ots)?")
_SEQUENCE = 0x30
"""Tag of ASN.1."""
_PROOF = b"\x00OpenTimestamps\x00\x00Proof\x00"
_KINDS = {
    ".tsr": "is no response of a time-stamping authority (RFC 3161)",
    ".ots": "is no proof of OpenTimestamps",
}
_MOST_BYTES = 1 << 20
"""Of a stamp: far more than any has."""


def registration_files(campaign: Campaign) -> list[Path]:
    """Return the registrations' files, in the order of their numbers."""
    found = (FILE.fullmatch(path.name) for path in (campaign.folder / REGISTRATIONS).glob("*.json"))
    names = sorted((int(match["number"]), match[0]) for match in found if match)
    return [campaign.folder / REGISTRATIONS / name for _, name in names]


def registrations(campaign: Campaign) -> list[tuple[Path, Registration]]:
    """Read a campaign's registrations, in order; none where it was not registered.

    Raises:
        StoreError: one is damaged, or was written by a newer version.
    """
    found = []
    for path in registration_files(campaign):
        try:
            found.append((path, Registration.load(path)))
        except (OSError, ValueError) as error:
            raise StoreError(f"{error}; restore it from a copy") from None
    return found


def add_registration(campaign: Campaign, content: Json) -> Path:
    """Write the next registration; the caller holds the store's lock.

    Args:
        content: all keys but format, campaign, number, previous and sum.

    Raises:
        StoreError: an earlier one is damaged or missing, or the number was taken in the meantime.
    """
    for damaged, what in registration_problems(campaign):
        raise StoreError(f"{damaged}: {what}; restore it from a copy")
    before = registrations(campaign)
    number = before[-1][1].number + 1 if before else 1
    data = {
        "format": Registration.FORMAT,
        "campaign": campaign.name,
        "number": number,
        "previous": sha256(before[-1][0]) if before else None,
        **content,
    }
    data["sum"] = hash_data(data)
    path = campaign.inside(campaign.folder / REGISTRATIONS) / f"{number:04d}.json"
    make_folder(path.parent)
    _write_new(path, json_text(Registration.parse(data, path).to_json()).encode())
    return path


def stamps(path: Path) -> list[Path]:
    """Return the stamps of a registration's file."""
    found = (path.with_name(path.name + ending) for ending in STAMPS)
    return [stamp for stamp in found if stamp.is_file()]


def attach_stamp(files: Sequence[Path], stamp: Path) -> Path:
    """Copy a stamp to the registration that it is of; the authority's signature is not checked.

    Args:
        files: of the registrations.

    Raises:
        InputError: it is of another kind, or of none of the files.
        StoreError: the registration has another stamp of this kind.
    """
    ending = stamp.suffix.lower()
    if ending not in STAMPS:
        raise InputError("--stamp", "", str(stamp), f"must end in {' or '.join(STAMPS)}")
    try:
        data = read_plain(stamp, _MOST_BYTES)
    except OSError as error:
        raise InputError(
            "--stamp", "", str(stamp), f"cannot be read: {error.strerror or error}"
        ) from None
    if not _is_stamp(data, ending):
        raise InputError("--stamp", "", str(stamp), _KINDS[ending])
    path = next((it for it in reversed(files) if _stamp_problem(data, it) is None), None)
    if path is None:
        problem = _stamp_problem(data, files[-1])
        raise InputError("--stamp", "", str(stamp), problem or "")
    target = path.with_name(path.name + ending)
    if ending == ".ots":  # a proof is completed when the calendar has published it
        write_bytes(target, data)
    elif not target.exists() or target.read_bytes() != data:
        _write_new(target, data)
    return target


def copy_registrations(campaign: Campaign, folder: Path) -> None:
    """Copy a campaign's registrations and their stamps into `folder`, if there are any."""
    for path in registration_files(campaign):
        make_folder(folder)
        for file in (path, *stamps(path)):
            write_bytes(folder / file.name, campaign.inside(file).read_bytes())


def _write_new(path: Path, data: bytes) -> None:
    if not write_new_bytes(path, data):
        raise StoreError(f"{path}: exists and is never overwritten")
    protect(path)


def _is_stamp(data: bytes, ending: str) -> bool:
    """Return whether data begin as a stamp does: a response with its status, or a proof."""
    if ending == ".ots":
        return data.startswith(_PROOF)
    if len(data) < 2 or data[0] != _SEQUENCE:
        return False
    head = 2 + (data[1] & 0x7F if data[1] & 0x80 else 0)  # DER: a long length has further bytes
    return data[head : head + 1] == bytes([_SEQUENCE])  # a request begins with its version


def _stamp_problem(data: bytes, path: Path) -> str | None:
    """Return the fault of a stamp; both kinds contain the digest of the stamped file."""
    if bytes.fromhex(sha256(path)) in data:
        return None
    return f"is not of {path}: it does not contain the SHA-256 of that file"


def registration_problems(campaign: Campaign) -> Iterator[tuple[Path, str]]:
    """Yield every file of a campaign's registrations that is damaged, missing or foreign."""
    folder = campaign.folder / REGISTRATIONS
    before: str | None = None
    sums = set()
    for place, path in enumerate(registration_files(campaign), 1):
        try:
            what = _problem(campaign, place, path, before)
            before = sha256(path)
        except (OSError, ValueError) as error:
            if own_fault(error):
                raise
            what, before = f"cannot be read: {error}", None
        sums.add(before)
        if what is not None:
            yield path, what
    for path in sorted(folder.iterdir()) if folder.is_dir() else []:
        match = FILE.fullmatch(path.name)
        if match is None and not is_temporary(path.name):
            yield path, "does not belong here"
        elif match is not None and match["stamp"] is not None:
            registered = folder / match["file"]
            what = "is of no registration"
            if registered.is_file():
                what = _stamp_problem(path.read_bytes(), registered) or ""
            if what:
                yield path, what
    for session in sorted((campaign.folder / "bench").glob("*.json")):
        known = _registration_of(session)
        if known is not None and known not in sums:
            yield session, f"was registered with a file that is missing or changed: {known}"


def _registration_of(session: Path) -> str | None:
    """Return the SHA-256 of the registration that a session was begun with, if it names one."""
    try:
        return read_json(session).get("registration")
    except (OSError, ValueError):
        return None  # not a matter of the registration


def _problem(campaign: Campaign, place: int, path: Path, before: str | None) -> str | None:
    """Return the fault of a registration's file; None if it is unchanged."""
    found = Registration.load(path)
    data = found.to_json()
    if json_text(data).encode() != path.read_bytes():
        return "is not as it was written: keys are sorted, one a line"
    if data.pop("sum") != hash_data(data):
        return "does not match its checksum"
    if (found.campaign, path.name) != (campaign.name, f"{found.number:04d}.json"):
        return f"is number {found.number} of campaign '{found.campaign}'"
    if found.number != place or found.previous != before:
        return "does not follow the registration before it, which is missing or changed"
    return None
