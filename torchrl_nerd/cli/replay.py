"""``nerd replay``: the steps before a fault again, in the model and in MuJoCo."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.cli.options import Positional
from torchrl_nerd.evaluation.replay import read_dump, replay


@dataclass(frozen=True)
class Replay(DeviceCommand):
    """The steps before a fault again, in the model and in MuJoCo.

    Envs with a dump_dir leave dumps: make_env(..., dump_dir=Path("faults")).

    Example: nerd replay faults/fault_diverged.safetensors
    """

    file: Positional[Path]
    """The dump."""
    model: str | None = None
    """Checkpoint folder; the shipped model of its scene by default."""

    def run(self) -> dict[str, Any]:
        """Print a line per step and return the results."""
        dump = read_dump(self.file)
        about = dump.about
        model = from_pretrained(self.model or about["scene"], dump.scene)
        model = model.to(self.device)
        steps = replay(dump, model)
        print(
            f"{about['reason']} in env {about.get('env', '?')} of {about['scene']}, "
            f"stepped by {about.get('dynamics', '?')}"
        )
        print("  ".join(f"{key:>14}" for key in steps[0]))
        for step in steps:
            print("  ".join(f"{value:>14.3g}" for value in step.values()))
        return {**about, "steps": steps}
