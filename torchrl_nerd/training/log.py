"""Figures of a training run: CSV always, TensorBoard where it is installed."""

import csv
from importlib.util import find_spec
from pathlib import Path

from torchrl_nerd.files import write_atomically


class TrainingLog:
    """Appends one row of figures per validation to ``log.csv``.

    Args:
        folder: of the run.
        step: rows after it, left by a run that was killed, are dropped.
    """

    def __init__(self, folder: Path, step: int) -> None:
        self.path = folder / "log.csv"
        self.rows = [row for row in self._read() if int(row["step"]) <= step]
        self.board = None
        if find_spec("tensorboard") is not None:
            from torch.utils.tensorboard import SummaryWriter

            self.board = SummaryWriter(folder / "tensorboard", purge_step=step)

    def _read(self) -> list[dict[str, str]]:
        if not self.path.exists():
            return []
        try:
            if not self.path.is_file():
                raise ValueError
            with open(self.path, newline="") as file:
                rows = list(csv.DictReader(file, strict=True))
            for row in rows:
                if None in row or None in row.values() or int(row["step"]) < 0:
                    raise ValueError
        except (ValueError, KeyError, csv.Error):
            raise ValueError(
                f"expected a table of figures by 'step' in {self.path}, got another"
            ) from None
        return rows

    def _write_rows(self, path: Path) -> None:
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(self.rows[0]))
            writer.writeheader()
            writer.writerows(self.rows)

    def write(self, figures: dict[str, float]) -> None:
        """Add a row; the file is whole after every call."""
        self.rows.append({key: repr(value) for key, value in figures.items()})
        write_atomically(self.path, self._write_rows)
        if self.board is not None:
            for key, value in figures.items():
                self.board.add_scalar(key, value, int(figures["step"]))
