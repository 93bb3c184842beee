"""The ``nerd`` command, one file for each of its commands."""

from torchrl_nerd.cli.main import COMMANDS, main

__all__ = ["COMMANDS", "main"]
