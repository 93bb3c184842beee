"""Loggers of a training besides its table: TorchRL's, so that a resumed run continues."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from torchrl.record.loggers import MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

LoggerName = Literal["tensorboard", "wandb", "mlflow", "csv"]

PROJECT = "torchrl_nerd"


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
    return (_open_wandb if name == "wandb" else _open_mlflow)(
        folder.resolve(), settings
    )


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


def close(logger: Logger) -> None:
    """Write what is left and end the run."""
    if isinstance(logger, MLFlowLogger):
        import mlflow

        mlflow.end_run()
    else:
        logger.close()
