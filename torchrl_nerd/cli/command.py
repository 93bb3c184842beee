"""Base classes of commands: options, dry run, record of the results, device."""

import shlex
from abc import ABC, abstractmethod
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from torchrl_nerd import __version__
from torchrl_nerd.evaluation.results import make_record
from torchrl_nerd.files import write_json
from torchrl_nerd.settings import expect_device

SHOWN = ("json", "quiet", "dry_run")
"""Options that change no result."""


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """A command whose fields are its options."""

    interrupted: ClassVar[str] = "the same command resumes data and training"
    json: Path | None = None
    """Write results and all settings to this file."""
    dry_run: bool = False
    """Print what the command would do and all its settings, and exit."""

    @abstractmethod
    def run(self) -> dict[str, Any]:
        """Run the command and return its results."""

    @property
    def record(self) -> Path | None:
        """Where results and settings go."""
        return self.json

    def configuration(self) -> dict[str, Any]:
        """Every option and its value, which repeat the command."""
        return {k: v for k, v in asdict(self).items() if k not in ("json", "dry_run")}

    def keep(self, results: dict[str, Any]) -> None:
        """Write results and how they were made to `record`, where there is one."""
        if self.record is not None:
            write_json(self.record, self.content(results))

    def content(self, results: dict[str, Any]) -> dict[str, Any]:
        """Of the file: results, command, version and all settings."""
        how = {"command": type(self).__name__.lower(), "version": __version__}
        return how | {"configuration": self.configuration()} | results

    def inputs(self) -> Any:
        """What `run` works on; bad input raises ValueError here, before any work."""
        return None

    def plan(self) -> list[str]:
        """What `run` would do, in sentences; bad input is refused as in `run`."""
        self.inputs()
        return []

    def settings(self) -> list[str]:
        """Every option and its value, a line each."""
        options = asdict(self)
        options |= options.pop("config", {})
        return [f"  {k:<28} {v}" for k, v in options.items() if k != "dry_run"]


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """A command that computes on a device; one that torch does not find is refused."""

    device: str = "cpu"
    """Device of the model: cpu, cuda, or cuda:1 for the second GPU."""
    quiet: bool = False
    """Show no progress bar."""

    def __post_init__(self) -> None:
        expect_device(self.device)


@dataclass(frozen=True, kw_only=True)
class MeasuringCommand(DeviceCommand):
    """A command that writes its results in the schema of ``results/``."""

    def content(self, results: dict[str, Any]) -> dict[str, Any]:
        """Of the file, see `make_record`."""
        seed = getattr(self, "seed", None)
        return make_record(results, seed, self.command_line(), self.device)

    def command_line(self) -> str:
        """The command line that does the same again, without what only shows or writes."""
        words = ["nerd", type(self).__name__.lower()]
        for field in fields(self):
            value = getattr(self, field.name)
            if field.default is MISSING:  # positional
                words.append(str(value))
            elif value != field.default and field.name not in SHOWN:
                option = field.name.replace("_", "-")
                if isinstance(value, bool):
                    words.append(f"--{option}" if value else f"--no-{option}")
                else:
                    values = value if isinstance(value, tuple) else (value,)
                    words += [f"--{option}", *map(str, values)]
        return shlex.join(words)
