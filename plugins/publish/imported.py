"""Reader of publications with the store's own files: Croissant, and LeRobot next to its rows.

Files keep their bytes, so what was derived from a trial stays fresh. Each trial is copied, the copy
is checked as `sliplab verify` checks one, and only then becomes visible.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from stat import S_ISREG

from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.storage.errors import DamagedFile, StoreError
from sliplab.storage.files import (
    inside,
    make_folder,
    protect,
    sync_file,
    sync_folder,
    write_bytes,
    write_json_aside,
)
from sliplab.storage.formats.foreign import Damage, ForeignTrial, FormatError, broken
from sliplab.storage.formats.format import Format, Layout
from sliplab.storage.formats.stored import CampaignTexts, check_arrays
from sliplab.storage.interrupts import interruptible, uninterrupted
from sliplab.storage.schema.document import Document, DocumentError, NewerFormat
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.trial import Provenance, StreamCounts, SyncResult
from sliplab.storage.streams import Json
from sliplab.storage.trials.checksums import PROVENANCE
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import PROTOCOL, RIG, STORE, SYNC, Campaign, TrialStore
from sliplab.storage.trials.verify import trial_folders, verify_trial

CAMPAIGNS, CARD = "campaigns", "croissant.json"


def publication_at(path: Path) -> Path | None:
    """Return the publication that a path is, or a campaign of; None where it is neither."""
    folder = path.parent.parent if path.parent.name == CAMPAIGNS else path
    there = all((folder / name).is_file() for name in (STORE, CARD))
    return folder if there and (folder / CAMPAIGNS).is_dir() else None


def of_one_campaign(path: Path) -> Path | None:
    """Return the folder of the one campaign of a publication of MCAP files; None for others.

    Raises:
        InputError: the publication has several campaigns or none.
    """
    if not (path / CARD).is_file() or (path / STORE).exists() or not (path / CAMPAIGNS).is_dir():
        return None
    found = sorted(each for each in (path / CAMPAIGNS).iterdir() if each.is_dir())
    if len(found) != 1:
        raise _several(path, found)
    return found[0]


def _several(path: Path, folders: list[Path]) -> InputError:
    names = ", ".join(map(str, folders))
    return InputError(
        path,
        "",
        None,
        f"must be of one campaign; name one of these folders: {names}"
        if names
        else "holds no campaign",
    )


def read_publication(path: Path) -> Iterator[ForeignTrial]:
    """Yield the trials of a publication with one campaign, or of one campaign's folder in it.

    Raises:
        InputError: it has several campaigns or none, or one is damaged.
    """
    folder = publication_at(path)
    if folder is None:
        raise InputError(path, "", None, f"is no publication: it lacks {STORE} or {CARD}")
    try:
        store = TrialStore.open(folder)
        found = [item for item in store.campaigns() if path in (folder, item.folder)]
        if len(found) != 1:
            raise _several(path, [item.folder for item in store.campaigns()])
        (where,) = found
        texts = _texts(where)
        for trial in trial_folders(where):
            source = trial.relative_to(path).as_posix()
            try:
                made = _trial(store, where, texts, trial, source)
            except InputError as error:
                made = replace(broken(trial.name, source, error), campaign=texts)
            except StoreError as error:
                fault = DamagedFile(trial, "", None, str(error).removeprefix(f"{trial}: "))
                made = replace(broken(trial.name, source, fault), campaign=texts)
            yield made
    except StoreError as error:
        raise DamagedFile(path, "", None, str(error).removeprefix(f"{path}: ")) from None


def _texts(where: Campaign) -> CampaignTexts:
    info = where.info
    texts = []
    for name in (PROTOCOL, RIG):
        file = _plain(inside(where.folder / name, where.folder.parents[1]))
        try:
            texts.append(file.read_text("utf-8"))
        except (OSError, UnicodeDecodeError) as error:
            raise DamagedFile(file, "", None, f"cannot be read: {error}") from None
        parse_yaml(texts[-1], file)
    return CampaignTexts(info, *texts)


def _plain(file: Path) -> Path:
    """Return a file. Raises DamagedFile if it is not a regular file; links may lead anywhere."""
    try:
        plain = S_ISREG(file.lstat().st_mode)
    except OSError:
        plain = False
    if not plain:
        raise DamagedFile(file, "", None, "is missing or not a regular file")
    return file


def _trial(
    store: TrialStore, where: Campaign, texts: CampaignTexts, folder: Path, source: str
) -> ForeignTrial:
    if folder.is_symlink() or not folder.is_dir():
        raise DamagedFile(folder, "", None, "is not a trial folder")
    labels = Derived.of(store, LABELS, where.name)
    retained = {
        LABELS: [labels.folder / f"{folder.name}.json", labels.arrays_path(folder.name)],
        SYNC: [where.sync_file(folder.name)],
    }
    record = Recording(folder).record
    return ForeignTrial(
        folder.name,
        source,
        lambda: iter(()),
        "the trial's time line",
        simulated=record.simulated,
        campaign=texts,
        original=PublishedTrial(
            folder,
            record.counts,
            {step: [f for f in files if f.exists()] for step, files in retained.items()},
        ),
    )


@dataclass(frozen=True)
class PublishedTrial:
    """A trial whose files are as they were in its store.

    Attributes:
        derived: files of its label and of its refitted clocks, by step, as far as it has them.
    """

    folder: Path
    counts: StreamCounts
    derived: dict[str, list[Path]]

    @uninterrupted
    def restore(
        self, store: TrialStore, campaign: Campaign, name: str, about: Json
    ) -> StreamCounts:
        """Commit the trial with its label and clocks.

        Args:
            about: what its provenance keeps of the import.

        Raises:
            FormatError: a file is missing, damaged, or does not belong to a trial.
        """
        incoming, target = campaign.places(name)
        made: list[Path] = []
        try:
            make_folder(incoming)
            self._copy(incoming, about)
            made += self._copy_derived(store, campaign)
            os.rename(incoming, target)
        except BaseException:
            shutil.rmtree(incoming, ignore_errors=True)
            for path in made:
                path.unlink(missing_ok=True)
            raise
        sync_folder(target.parent)
        return self.counts

    @interruptible
    def _copy(self, incoming: Path, about: Json) -> None:
        for file in sorted(self.folder.iterdir()):
            if not S_ISREG(file.lstat().st_mode):
                raise Damage("does not belong to a trial", file)
            shutil.copyfile(file, incoming / file.name, follow_symlinks=False)
        for problem in verify_trial(incoming):
            raise Damage(problem.what, self.folder / Path(problem.path).name)
        found = Provenance.load(incoming / PROVENANCE).to_json()
        write_json_aside(
            incoming / PROVENANCE, Provenance.model_validate({**found, **about}).to_json()
        )
        for file in incoming.iterdir():
            sync_file(file)
            protect(file)
        sync_folder(incoming)

    def _copy_derived(self, store: TrialStore, campaign: Campaign) -> Iterator[Path]:
        for step, files in self.derived.items():
            target = Derived.of(store, step, campaign.name).folder
            for file in sorted(files, reverse=True):  # arrays first: the document decides
                data = self._checked(step, file)
                make_folder(target)
                yield target / file.name
                write_bytes(target / file.name, data)

    def _checked(self, step: str, file: Path) -> bytes:
        data = _plain(file).read_bytes()
        kind: type[Document] = SyncResult if step == SYNC else TrialLabel
        try:
            if file.suffix == ".npz":
                check_arrays(data)
            else:
                kind.load(file)
        except FormatError as error:
            raise Damage(str(error), file) from None
        except (DocumentError, NewerFormat) as error:
            raise Damage(str(error).removeprefix(f"{file}: "), file) from None
        return data


CROISSANT = Format(
    sniff=lambda path, head: publication_at(path) is not None, read_all=read_publication
)
LAYOUT = Layout(
    folder=of_one_campaign, owns=lambda entry: of_one_campaign(entry.parent) is not None
)
