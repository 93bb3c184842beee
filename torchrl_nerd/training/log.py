"""Metrics of a training run: a table always, and one of TorchRL's loggers."""

import csv
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from torchrl.record.loggers import MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

from torchrl_nerd.files import write_atomically

LoggerName = Literal["tensorboard", "wandb", "mlflow", "csv"]
PROJECT = "torchrl_nerd"


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
            rest = dict(metrics)
            step = int(rest.pop("step"))
            self.logger.log_metrics(rest, step=step)

    def close(self) -> None:
        """Write what is left and end the logger's run."""
        if isinstance(self.logger, MLFlowLogger):
            import mlflow

            mlflow.end_run()
        elif self.logger is not None:
            self.logger.close()


class ResumableTensorboardLogger(TensorboardLogger):
    """TorchRL's logger, which drops what a killed run wrote from ``step`` on."""

    def __init__(self, folder: Path, step: int) -> None:
        self.step = step
        super().__init__("tensorboard", str(folder))

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(Path(self.log_dir) / self.exp_name, purge_step=self.step)


def open_logger(
    name: LoggerName, folder: Path, step: int, settings: dict[str, Any]
) -> Logger | None:
    """The logger of a run; None for the table alone.

    | name | where metrics go |
    |---|---|
    | ``tensorboard`` | ``tensorboard`` in the folder, if it is installed |
    | ``wandb`` | Weights & Biases; with ``WANDB_MODE=offline``, ``wandb`` in the folder |
    | ``mlflow`` | ``MLFLOW_TRACKING_URI``; without it, ``mlflow.db`` in the folder |
    | ``csv`` | nowhere else |

    Weights & Biases and MLflow begin another run where training resumes.

    Args:
        name: of the logger.
        folder: of the run.
        step: update at which the run begins or resumes.
        settings: of the training, which Weights & Biases and MLflow show.

    Raises:
        ModuleNotFoundError: Weights & Biases or MLflow is not installed.
        RuntimeError: Weights & Biases has no key.
    """
    if name == "csv" or (name == "tensorboard" and find_spec("tensorboard") is None):
        return None
    if find_spec(name) is None:
        raise ModuleNotFoundError(
            f"--logger {name} needs the package {name}, which is not installed: "
            f"pip install 'torchrl-nerd[{name}]'"
        )
    if name == "tensorboard":
        return ResumableTensorboardLogger(folder, step)
    make = _open_wandb if name == "wandb" else _open_mlflow
    return make(folder.resolve(), settings)


def _open_wandb(folder: Path, settings: dict[str, Any]) -> WandbLogger:
    from wandb.errors import UsageError

    how = {"project": PROJECT, "config": settings, "log_env_packages": False}
    try:
        return WandbLogger(folder.name, save_dir=str(folder), **how)
    except UsageError as error:
        raise RuntimeError(
            f"Weights & Biases: {error} WANDB_MODE=offline needs no key."
        ) from None


def _open_mlflow(folder: Path, settings: dict[str, Any]) -> MLFlowLogger:
    import mlflow

    store = os.environ.get("MLFLOW_TRACKING_URI")
    place = None if store else (folder / "mlflow").as_uri()
    store = store or f"sqlite:///{folder}/mlflow.db"
    logger = MLFlowLogger(PROJECT, store, artifact_location=place)
    mlflow.set_tag("mlflow.runName", folder.name)
    mlflow.log_params(settings)  # the logger's own method needs omegaconf
    return logger
