"""Metrics of a training run: a table always, and one of TorchRL's loggers."""

import csv
from pathlib import Path

from torchrl.record.loggers.common import Logger

from torchrl_nerd.files import write_atomically
from torchrl_nerd.training.loggers import close


class TrainingLog:
    """Appends the metrics of each validation to ``log.csv``, which is never cut.

    Args:
        folder: of the run.
        step: rows after this update, written by a run that was killed, are dropped.
        logger: gets the same metrics; see `open_logger`.
    """

    def __init__(self, folder: Path, step: int, logger: Logger | None = None) -> None:
        self.path, self.logger = folder / "log.csv", logger
        self.rows = [row for row in self._read() if int(row["step"]) <= step]

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
                f"expected a table of metrics by 'step' in {self.path}, got another"
            ) from None
        return rows

    def _write_rows(self, path: Path) -> None:
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(self.rows[0]))
            writer.writeheader()
            writer.writerows(self.rows)

    def write(self, metrics: dict[str, float]) -> None:
        """Add a row; the file is whole after every call."""
        self.rows.append({key: repr(value) for key, value in metrics.items()})
        write_atomically(self.path, self._write_rows)
        if self.logger is not None:
            step = int(metrics["step"])
            rest = {key: value for key, value in metrics.items() if key != "step"}
            self.logger.log_metrics(rest, step=step)

    def close(self) -> None:
        """End the logger's run."""
        if self.logger is not None:
            close(self.logger)
