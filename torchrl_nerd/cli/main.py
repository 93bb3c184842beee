"""The ``nerd`` command: reads options and runs; bad input becomes one sentence."""

import io
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import fields
from itertools import pairwise
from typing import Any

import tyro

from torchrl_nerd import __version__
from torchrl_nerd.cli.bench import Bench
from torchrl_nerd.cli.command import Command
from torchrl_nerd.cli.data import Data
from torchrl_nerd.cli.doctor import Doctor
from torchrl_nerd.cli.eval import Eval
from torchrl_nerd.cli.explain import Explain
from torchrl_nerd.cli.finetune import Finetune
from torchrl_nerd.cli.help import REGISTRY, tidy
from torchrl_nerd.cli.play import Play
from torchrl_nerd.cli.stability import Stability
from torchrl_nerd.cli.train import Train
from torchrl_nerd.cli.transfer import Transfer
from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.files import check_writable
from torchrl_nerd.robots import SCENES, preset_of
from torchrl_nerd.scenes import is_import
from torchrl_nerd.settings import SettingError, did_you_mean

KINDS = Data, Train, Eval, Finetune, Transfer, Play, Explain, Bench, Stability, Doctor
COMMANDS: dict[str, type[Command]] = {kind.__name__.lower(): kind for kind in KINDS}
INTERRUPTED = 130  # exit status of a process that Ctrl-C ended


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; bad input is one sentence on stderr and exit status 2."""
    argv = list(sys.argv[1:] if argv is None else argv)
    if argv == ["--version"]:
        print(f"nerd {__version__}")
        return 0
    if not argv or argv[0] in ("-h", "--help"):
        print("usage: nerd COMMAND ... (each with --help), nerd --version\n")
        for name, command in COMMANDS.items():
            print(f"  {name:<10}{(command.__doc__ or '').splitlines()[0]}")
        return 0
    if argv[0] not in COMMANDS:
        meant, known = did_you_mean(argv[0], COMMANDS), ", ".join(COMMANDS)
        return _fail(f"unknown command '{argv[0]}'{meant}, expected {known}")
    kind = COMMANDS[argv[0]]
    try:
        command = _parse(kind, argv)
        if command.record is not None:  # refuse it before any work
            check_writable(command.record)
        if command.dry_run:
            print("\n".join((*command.plan(), *command.settings())))
            return 0
        command.keep(command.run())
        sys.stdout.flush()
    except BrokenPipeError:  # who read its output, such as `head`, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (ValueError, OSError, RuntimeError, ModuleNotFoundError) as error:
        return _fail((str(error) or repr(error)).splitlines()[0])
    except KeyboardInterrupt:  # Ctrl-C
        return _fail(f"interrupted; {kind.interrupted}", INTERRUPTED)
    return 0


def _parse(kind: type[Command], argv: list[str]) -> Command:
    """The command with its settings; tyro's boxes point at what cannot be read.

    Raises:
        SettingError: a setting out of range, in its own words and without a box.
    """
    said, shown = io.StringIO(), io.StringIO()
    name, *args = argv
    try:
        with redirect_stderr(said), redirect_stdout(shown), REGISTRY:
            args = _with_scene_first(kind, args)
            default = _default(kind, args)
            return tyro.cli(kind, prog=f"nerd {name}", args=args, default=default)
    except SystemExit as stop:
        cause: BaseException | None = stop
        while cause := cause.__cause__ or cause.__context__:
            if isinstance(cause, SettingError):
                raise cause from None
        sys.stderr.write(tidy(said.getvalue()))
        sys.stdout.write(tidy(shown.getvalue()))
        raise


def _default(kind: type[Command], args: list[str]) -> Any:
    """Defaults of ``data`` and ``train``: the preset of the scene that is named first."""
    if kind not in (Data, Train) or not args or args[0].startswith("-"):
        return tyro.MISSING_NONPROP
    if not ((scene := args[0]) in SCENES or is_import(scene)):
        return tyro.MISSING_NONPROP
    preset = preset_of(scene)
    if kind is Data:
        return Data(scene=scene, config=preset.data)
    is_hybrid = "--kind=hybrid" in args or ("--kind", "hybrid") in pairwise(args)
    if is_hybrid and preset.hybrid is not None:
        return Train(scene=scene, kind="hybrid", config=preset.hybrid)
    return Train(scene=scene, config=preset.train)


def _with_scene_first(kind: type[Command], args: list[str]) -> list[str]:
    """Arguments with the robot before all options, of which one may take several words.

    It is the first word that names a robot and is no option's one value.
    """
    if kind not in (Data, Train):
        return args
    options = *fields(kind), *fields(DataConfig if kind is Data else TrainConfig)
    flags = [x.name for x in options if isinstance(x.default, bool)]
    for at, (before, word) in enumerate(pairwise(["", *args])):
        name = before.removeprefix("--").replace("-", "_").removeprefix("no_")
        is_value = before.startswith("--") and "=" not in before and name not in flags
        if not is_value and (word in SCENES or is_import(word)):
            return [word, *args[:at], *args[at + 1 :]]
    return args


def _fail(sentence: str, status: int = 2) -> int:
    print(f"nerd: {sentence}", file=sys.stderr)
    return status
