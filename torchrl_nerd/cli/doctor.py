"""``nerd doctor``: what this machine has, and whether the shipped models work on it."""

from dataclasses import dataclass
from typing import Any

from torchrl_nerd import __version__
from torchrl_nerd.cli.command import Command
from torchrl_nerd.evaluation.doctor import PACKAGES, machine, shipped_checks
from torchrl_nerd.evaluation.results import versions


@dataclass(frozen=True)
class Doctor(Command):
    """Versions, devices, and the self-check of every shipped model.

    Example: nerd doctor --json results/doctor.json
    """

    quiet: bool = False
    """No progress bar."""

    def run(self) -> dict[str, Any]:
        """Print what was found and return it.

        Raises:
            RuntimeError: a shipped model does not repeat its stored steps.
        """
        packages = {"torchrl_nerd": __version__, **versions(*PACKAGES)}
        found = {"versions": packages, "machine": machine()}
        for title, entries in found.items():
            print(title)
            for key, value in entries.items():
                print(f"  {key:<14}{value}")
        print("shipped models: relative difference from their stored steps")
        checks = shipped_checks(self.quiet)
        for name, check in checks.items():
            if "error" in check:
                print(f"  {name:<28}{check['error']}")
                continue
            differences = f"MuJoCo {check['mujoco']:.0e}, model {check['model']:.0e}"
            verdict = "ok" if check["agrees"] else "DIFFERS"
            print(f"  {name:<28}{differences:<30}{check['seconds']:>5} s  {verdict}")
        wrong = [name for name, check in checks.items() if not check["agrees"]]
        if wrong:
            raise RuntimeError(
                f"expected every shipped model to repeat its stored steps, "
                f"{', '.join(wrong)} did not"
            )
        return {**found, "models": checks}
