"""Two processes that share every batch end where one does, up to rounding."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from torchrl_nerd.cli import main
from torchrl_nerd.configs import DataConfig, TrainConfig
from torchrl_nerd.data.generate import generate
from torchrl_nerd.robots import load_scene
from torchrl_nerd.training import ranks
from torchrl_nerd.transforms import Stats

BRIEF = (
    *(
        "--steps",
        "12",
        "--rollout-steps",
        "3",
        "--batch-size",
        "8",
        "--sequence-length",
        "4",
    ),
    *("--rollout-batch-size", "4", "--rollout-length", "3", "--warmup", "2"),
    *("--save-every", "5", "--validate-every", "3", "--quiet", "--threads", "1"),
    *("--bf16-fraction", "0"),  # whose rounding is a thousand times as coarse
)


def arguments(name: str, folder: Path, out: str, *more: str) -> list[str]:
    """Of ``nerd train``, brief, on the data in a folder."""
    places = "--data", str(folder / "data"), "--out", str(folder / out)
    return ["train", name, *places, *BRIEF, *more]


def train_in_two(*given: str) -> subprocess.CompletedProcess[str]:
    """``nerd`` in two processes."""
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone"]
    command += ["--nproc-per-node", "2", "-m", "torchrl_nerd.cli", *given]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.run(
        command, capture_output=True, text=True, env=environment, timeout=300
    )


@pytest.mark.parametrize(
    ("name", "more"),
    [
        ("double_pendulum", ()),
        pytest.param(
            "cube",
            ("--network", "mlp-1x32", "--use-symmetry"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_two_ranks_make_the_model_of_one(name, more, tmp_path, capsys):
    generate(load_scene(name), DataConfig(60, 8), tmp_path / "data", quiet=True)
    assert main(arguments(name, tmp_path, "one", *more)) == 0
    done = train_in_two(*arguments(name, tmp_path, "two", *more))
    assert done.returncode == 0, done.stderr[-2000:]
    for said in (capsys.readouterr().out, done.stdout):
        assert said.count("checkpoint in") == said.count("\n") == 1
    states, losses = [], []
    for out in (tmp_path / "one", tmp_path / "two"):
        states.append(load_file(out / "state.safetensors"))
        with open(out / "log.csv", newline="") as file:
            losses.append([float(row["loss"]) for row in csv.DictReader(file)])
    assert states[0]["step"] == states[1]["step"] == 15
    for key, value in states[0].items():
        if key.startswith(("model.", "average.")):
            if value.ndim == 2:  # torch.optim.Muon rounds its updates to bfloat16
                assert (states[1][key] - value).norm() < 1e-2 * value.norm()
            else:
                torch.testing.assert_close(states[1][key], value, atol=2e-4, rtol=1e-3)
    assert len(losses[0]) == 5
    torch.testing.assert_close(*map(torch.tensor, losses), atol=0.0, rtol=1e-3)


@pytest.mark.slow
def test_shares_that_are_not_equal_are_refused(tmp_path):
    name = "cartpole"
    generate(load_scene(name), DataConfig(20, 8), tmp_path / "data", quiet=True)
    done = train_in_two(*arguments(name, tmp_path, "run", "--batch-size", "9"))
    assert done.returncode != 0
    assert "expected batch_size to be a multiple of the 2 ranks, got 9" in done.stderr


def test_alone_nothing_changes(generator):
    assert (ranks.rank(), ranks.world()) == (0, 1)
    x = torch.randn(6, 2, generator=generator)
    assert torch.equal(ranks.share(x), x)
    stats = Stats.of(x)
    assert ranks.merge_stats(stats) is stats
    ranks.expect_shares(batch_size=TrainConfig().batch_size)
