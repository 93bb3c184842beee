"""What commands share: where figures go, a run that does nothing, a device."""

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

from torchrl_nerd import __version__
from torchrl_nerd.files import write_json
from torchrl_nerd.settings import expect_device


@dataclass(frozen=True, kw_only=True)
class Command(ABC):
    """A command whose fields are its options."""

    json: Path | None = None
    """Write the figures and all settings to this file."""
    dry_run: bool = False
    """Say what would be done and with which settings, and do none of it."""

    @abstractmethod
    def run(self) -> dict[str, Any]:
        """Do it and return the figures."""

    @property
    def picture(self) -> Path | None:
        """The film or figure that `run` leaves, where it leaves one."""
        return None

    @property
    def record(self) -> Path | None:
        """Where figures and settings go: as asked for, or beside the picture."""
        if self.json is not None or self.picture is None:
            return self.json
        return self.picture.with_name(f"{self.picture.name}.json")

    def configuration(self) -> dict[str, Any]:
        """Every option and its value, with which `run` does the same again."""
        return {k: v for k, v in asdict(self).items() if k not in ("json", "dry_run")}

    def keep(self, figures: dict[str, Any]) -> None:
        """Write figures and settings to `record`, where that is asked for."""
        if self.record is not None:
            how: dict[str, Any] = {"command": type(self).__name__.lower()}
            how |= {"version": __version__, "configuration": self.configuration()}
            write_json(self.record, how | figures)

    def plan(self) -> list[str]:
        """What `run` would do, in sentences; bad input is refused as there."""
        return []

    def settings(self) -> list[str]:
        """Every option and its value, a line each."""
        return [f"  {name:<20}{value}" for name, value in _leaves(self)]


@dataclass(frozen=True, kw_only=True)
class DeviceCommand(Command):
    """A command whose model computes where it is told to.

    Raises:
        SettingError: a device that this machine has not.
    """

    device: str = "cpu"
    """Of the model: cpu, cuda, or cuda:1 for the second of several."""

    def __post_init__(self) -> None:
        expect_device(self.device)


def _leaves(options: Any) -> Iterator[tuple[str, Any]]:
    """Names and values, those of dataclasses within in their place."""
    for field in fields(options):
        value = getattr(options, field.name)
        if is_dataclass(value):
            yield from _leaves(value)
        elif field.name != "dry_run":
            yield field.name, value
