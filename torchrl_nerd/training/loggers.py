"""Where metrics of a training run go beside its table: one of TorchRL's loggers."""

import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

from torchrl.record.loggers import MLFlowLogger, TensorboardLogger, WandbLogger
from torchrl.record.loggers.common import Logger

LoggerName = Literal["tensorboard", "wandb", "mlflow", "csv"]

PROJECT = "torchrl_nerd"


class Board(TensorboardLogger):
    """TensorBoard files that forget what a killed run wrote after ``step``."""

    def __init__(self, folder: Path, step: int) -> None:
        self.step = step
        super().__init__("tensorboard", str(folder))

    def _create_experiment(self) -> Any:
        from torch.utils.tensorboard import SummaryWriter

        return SummaryWriter(Path(self.log_dir) / self.exp_name, purge_step=self.step)


def open_logger(
    name: LoggerName, folder: Path, step: int, settings: dict[str, Any]
) -> Logger | None:
    """The logger of a run in ``folder`` that goes on at ``step``.

    | name | where metrics go |
    |---|---|
    | ``tensorboard`` | ``tensorboard`` in the folder, if it is installed |
    | ``wandb`` | Weights & Biases; with ``WANDB_MODE=offline``, ``wandb`` in the folder |
    | ``mlflow`` | ``MLFLOW_TRACKING_URI``; without it, ``mlflow.db`` in the folder |
    | ``csv`` | nowhere else |

    Weights & Biases and MLflow begin another run where training goes on.

    Raises:
        ModuleNotFoundError: Weights & Biases or MLflow is not installed.
        RuntimeError: Weights & Biases does not know who you are.
    """
    if name == "csv" or (name == "tensorboard" and find_spec("tensorboard") is None):
        return None
    if find_spec(name) is None:
        raise ModuleNotFoundError(
            f"--logger {name} needs the package {name}, which is not installed: "
            f"pip install 'torchrl-nerd[{name}]'"
        )
    if name == "tensorboard":
        return Board(folder, step)
    run = folder.resolve().name
    if name == "wandb":
        return _open_wandb(run, folder, settings)
    return _open_mlflow(run, folder.resolve(), settings)


def _open_wandb(run: str, folder: Path, settings: dict[str, Any]) -> WandbLogger:
    from wandb.errors import UsageError

    try:
        return WandbLogger(
            run,
            save_dir=str(folder),
            project=PROJECT,
            config=settings,
            log_env_packages=False,
        )
    except UsageError as error:
        raise RuntimeError(
            f"Weights & Biases: {error} WANDB_MODE=offline needs no key."
        ) from None


def _open_mlflow(run: str, folder: Path, settings: dict[str, Any]) -> MLFlowLogger:
    import mlflow

    store = os.environ.get("MLFLOW_TRACKING_URI")
    logger = MLFlowLogger(
        PROJECT,
        store or f"sqlite:///{folder}/mlflow.db",
        artifact_location=None if store else (folder / "mlflow").as_uri(),
    )
    mlflow.set_tag("mlflow.runName", run)
    mlflow.log_params(settings)  # the logger's own way needs omegaconf
    return logger


def close(logger: Logger) -> None:
    """Write what is left and end the run."""
    if isinstance(logger, MLFlowLogger):
        import mlflow

        mlflow.end_run()
    else:
        logger.close()
