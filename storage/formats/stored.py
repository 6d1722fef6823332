"""Parts of a published trial besides its streams: its campaign, and the arrays of its label."""

from __future__ import annotations

from dataclasses import dataclass
from io import BytesIO
from zipfile import BadZipFile, ZipFile

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.trials.store import Campaign, CampaignInfo

_MOST_ARRAYS = 1 << 28


@dataclass(frozen=True)
class CampaignTexts:
    """The campaign that a trial is of, as its store had it."""

    info: CampaignInfo
    protocol: str
    rig: str

    def join(self, campaign: Campaign, source: str) -> None:
        """Describe a new campaign, under its own name; as `ForeignCampaign`."""
        info: CampaignInfo = {**self.info, "name": campaign.name}
        if not campaign.begun:
            campaign.update(info, self.protocol, self.rig)
        elif campaign.info != info:
            raise InputError(
                "--name",
                "",
                campaign.name,
                f"has another protocol or rig than {source}; choose another name, and "
                "import one campaign at a time",
            )
        else:
            campaign.finish_description()


def check_arrays(data: bytes) -> None:
    """Check the arrays of a label, an ``.npz`` file. Raises FormatError where they are damaged."""
    try:
        with ZipFile(BytesIO(data)) as file:
            if sum(item.file_size for item in file.infolist()) > _MOST_ARRAYS:
                raise FormatError("holds arrays of a label that are too large")
        with np.load(BytesIO(data), allow_pickle=False) as arrays:
            for name in arrays.files:
                _ = arrays[name]
    except (ValueError, OSError, BadZipFile, EOFError, KeyError) as error:
        raise FormatError(f"holds damaged arrays of a label: {error}") from None
