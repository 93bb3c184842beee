"""Metrics of a training run: a table always, and one of TorchRL's loggers.

TorchRL's `CSVLogger` appends to one file per metric: a killed run could leave half a line,
and a resumed one would write its rows twice.
"""

import csv
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from torchrl.record.loggers import TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

from torchrl_nerd.files import writable_folder, write_atomically

LoggerName = Literal["tensorboard", "wandb", "csv"]
PROJECT = "torchrl_nerd"


class TrainingLog:
    """Appends the metrics of each validation to ``log.csv``, which is never cut.

    Rows after update ``step``, written by a run that was killed, are dropped. The logger of
    `open_logger` gets the same metrics.

    Raises:
        ValueError: ``log.csv`` is no table of metrics.
    """

    def __init__(self, folder: Path, step: int, logger: Logger | None = None) -> None:
        self.path, self.logger = folder / "log.csv", logger
        self.rows: list[dict[str, str]] = []
        if not self.path.exists():
            return
        try:
            if not self.path.is_file():
                raise ValueError
            lines = self.path.read_text().splitlines()
            for row in csv.DictReader(lines, strict=True):
                if None in row or None in row.values() or int(row["step"]) < 0:
                    raise ValueError
                if int(row["step"]) <= step:
                    self.rows.append(row)
        except (ValueError, KeyError, csv.Error):
            raise ValueError(
                f"expected a table of metrics by 'step' in {self.path}, got another"
            ) from None

    def write(self, metrics: dict[str, float]) -> None:
        """Add a row; the file is whole after every call."""
        self.rows.append({key: repr(value) for key, value in metrics.items()})
        lines = [self.rows[0].keys(), *(row.values() for row in self.rows)]
        text = "".join(",".join(line) + "\n" for line in lines)
        write_atomically(self.path, lambda aside: aside.write_text(text))
        if self.logger is not None:
            rest = dict(metrics)
            self.logger.log_metrics(rest, step=int(rest.pop("step")))

    def close(self) -> None:
        """Write what is left and end the logger's run."""
        if self.logger is not None:
            self.logger.close()


class ResumableTensorboardLogger(TensorboardLogger):
    """TorchRL's logger, which drops what a killed run wrote after ``step``."""

    def __init__(self, folder: Path, step: int) -> None:
        self.step = step
        super().__init__("tensorboard", str(folder))

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(
            Path(self.log_dir) / self.exp_name, purge_step=self.step + 1
        )


def open_logger(
    name: LoggerName, folder: Path, step: int, settings: dict[str, Any]
) -> Logger | None:
    """The logger of a run; None for the table alone.

    | name | where metrics go |
    |---|---|
    | ``tensorboard`` | ``tensorboard`` in the folder, if it is installed |
    | ``wandb`` | Weights & Biases; with ``WANDB_MODE=offline``, ``wandb`` in the folder |
    | ``csv`` | nowhere else |

    Weights & Biases shows the ``settings`` of the training. It begins another run where
    training resumes, at update ``step``.

    Raises:
        ModuleNotFoundError: Weights & Biases is not installed.
        RuntimeError: Weights & Biases has no key.
        ValueError: the folder cannot be written.
    """
    is_missing = find_spec(name) is None
    if name == "csv" or (name == "tensorboard" and is_missing):
        return None
    if name == "tensorboard":
        return ResumableTensorboardLogger(folder, step)
    if is_missing:
        raise ModuleNotFoundError(
            f"--logger {name} needs the package {name}, which is not installed: "
            f"in the clone, pip install -e '.[{name}]'"
        )
    from wandb.errors import UsageError

    save_dir = str(writable_folder(folder).resolve())
    how = {"project": PROJECT, "config": settings, "log_env_packages": False}
    try:
        return WandbLogger(folder.name, save_dir=save_dir, **how)
    except UsageError as error:
        raise RuntimeError(
            f"Weights & Biases: {error} WANDB_MODE=offline needs no key."
        ) from None
