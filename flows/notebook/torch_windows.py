"""Windows as a data set of PyTorch."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch.utils.data import Dataset

from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.flows.notebook.datasets import classes_of

if TYPE_CHECKING:
    import pandas as pd


class TorchWindows(Dataset[tuple[torch.Tensor, int]]):
    """Event counts of windows with their classes, for a ``DataLoader``.

    An item is float32 of shape (steps, channels, cells, cells), and the class, which is -1 where a
    window has none.

    Attributes:
        windows: the table, a row for each item.
    """

    def __init__(self, counts: SparseWindows, windows: pd.DataFrame) -> None:
        self.windows, self._counts = windows, counts
        self._targets = classes_of(windows).tolist()

    def __len__(self) -> int:
        return len(self.windows)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, int]:
        index = range(len(self))[index]
        dense = self._counts.take(torch.tensor([index]).numpy()).dense()[0]
        return torch.from_numpy(dense).to(torch.float32), self._targets[index]
