"""Functions of one env in NumPy, for tasks whose starts or rewards are no tensor code."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchrl_nerd.compiled import uncompiled
from torchrl_nerd.locks import fork_safe_lock

_ONE_AT_A_TIME = fork_safe_lock()


class RowMemo:
    """A slow function of rows; a row that is the same as last time keeps its answer."""

    def __init__(self, function: Callable[[np.ndarray], np.ndarray]) -> None:
        self.function = function
        self._given, self._answers = np.zeros((0, 0)), np.zeros((0, 0))

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """Answers to ``rows (n, k)``; of the same n and k as last time, or all anew."""
        with _ONE_AT_A_TIME:  # one `Physics`, written in and read
            return self._answer(rows)

    def _answer(self, rows: np.ndarray) -> np.ndarray:
        is_known = np.zeros(len(rows), bool)
        if rows.shape == self._given.shape:  # bit for bit: NaN equals NaN
            is_known = (rows.view(np.int64) == self._given.view(np.int64)).all(-1)
        answers = [
            self._answers[i] if is_known[i] else self.function(row)
            for i, row in enumerate(rows)
        ]
        self._given, self._answers = rows, np.array(answers)
        return self._answers


@uncompiled
def on_rows(function: RowMemo, rows: Tensor) -> Tensor:
    """A function of NumPy rows ``(n, k)``, of float64 tensors ``(*batch, k)``."""
    flat = rows.double().flatten(0, -2).cpu().contiguous().numpy().copy()
    answers = torch.from_numpy(function(flat).copy())
    return answers.to(rows.device).unflatten(0, rows.shape[:-1])
