"""What each simulation of a batch has of its own: model fields, motor strength, delay."""

import numpy as np
import torch
from mujoco.batch import Batch

from torchrl_nerd.scenes.variation import Variation


class RowParameters:
    """Parameters of a `Variation` in a batch that begins with the scene's own model."""

    def __init__(self, variation: Variation, batch: Batch) -> None:
        self.variation, self.batch = variation, batch
        rows, dofs = batch.nsim, len(variation.actuated)
        self._values = np.full((rows, variation.size), np.nan)
        self._strength, self._delay = np.ones((rows, dofs)), np.zeros(rows, int)

    def write(self, parameters: np.ndarray) -> None:
        """Give every simulation its parameters ``(rows, size)``.

        Raises:
            ValueError: another shape, or parameters of no robot; nothing has changed then.
        """
        if parameters.shape != self._values.shape:
            raise ValueError(
                f"expected parameters of shape {self._values.shape}, got "
                f"{parameters.shape}"
            )
        rows = np.flatnonzero((parameters != self._values).any(1))
        if len(rows):
            self.variation.check(torch.from_numpy(parameters[rows]))
            values = self._values[rows] = parameters[rows]
            for name, value in self.variation.fields(values).items():
                self.batch.expand(name)[rows] = value
            self.batch.set_const(rows)
            self._strength[rows] = self.variation.strength(values)
            self._delay[rows] = self.variation.delay(values)

    def applied(
        self, command: np.ndarray, late: np.ndarray, is_ctrl: bool
    ) -> np.ndarray:
        """What the engine gets where ``command (rows, m)`` is asked of the motors.

        Of a ``ctrl`` the model itself weakens the actuators. ``late (rows, 1 + max_delay,
        at least m)`` holds the last commands, and takes this one in.
        """
        late[:, 1:] = late[:, :-1].copy()
        late[:, 0, : command.shape[1]] = command
        now = late[np.arange(len(late)), self._delay, : command.shape[1]]
        return now if is_ctrl else self._strength * now
