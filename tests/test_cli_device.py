"""``--device``: one option of every command that runs a model."""

import pytest
import torch
from helpers import EXCERPT
from tensordict import TensorDict

from torchrl_nerd.cli import COMMANDS, main
from torchrl_nerd.cli.command import DeviceCommand
from torchrl_nerd.evaluation.policy import Policy, save_policy

WITH_DEVICE = [
    name for name, kind in COMMANDS.items() if issubclass(kind, DeviceCommand)
]
NO_MODEL = {"data", "explain", "doctor"}  # MuJoCo, timings and checks of the processor
SMALL = {
    "train": "cartpole --data set --quiet --steps 1 --rollout-steps 0",
    "eval": "cartpole --num-trajectories 2",
    "finetune": f"cube --from {EXCERPT} --quiet",
    "transfer": "cartpole/swingup --policy policy --episodes 2",
    "play": "cartpole/swingup --steps 2 --quiet",
    "bench": "cartpole --batches 1 --num-trajectories 2 --rounds 1 --steps 2",
    "stability": "cartpole --cases batching",
}

each_command = pytest.mark.parametrize("command", WITH_DEVICE)


class SentAwayError(Exception):
    """A tensor or module was sent to the GPU."""


@pytest.fixture
def one_gpu(monkeypatch):
    """As with one CUDA device, up to the first thing that is sent there."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    for kind in (torch.Tensor, torch.nn.Module, TensorDict):

        def to(self, *args, real=kind.to, **kwargs):
            if any(str(x).startswith("cuda") for x in (*args, *kwargs.values())):
                raise SentAwayError
            return real(self, *args, **kwargs)

        monkeypatch.setattr(kind, "to", to)


@pytest.fixture
def prepared(tmp_path, monkeypatch):
    """A folder with what the commands of `SMALL` read."""
    monkeypatch.chdir(tmp_path)
    sizes = ["--trajectories", "8", "--steps", "20", "--quiet", "--out", "set"]
    assert main(["data", "cartpole", *sizes]) == 0
    save_policy(Policy((4, 8, 1)), tmp_path / "policy")


def test_commands_that_run_a_model_have_a_device_and_no_others():
    assert set(WITH_DEVICE) == set(COMMANDS) - NO_MODEL


@each_command
def test_the_processor_is_the_default(command, prepared, capsys):
    capsys.readouterr()
    assert main([command, *SMALL[command].split(), "--dry-run"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert ["device", "cpu"] in [line.split() for line in said]


@each_command
@pytest.mark.parametrize("device", ["cuda", "cuda:1", "meta", "nowhere", ""])
@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_a_device_that_is_not_there_is_refused(
    command, device, dry, monkeypatch, capsys
):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    argv = [command, *SMALL[command].split(), "--device", device, *dry]
    assert main(argv) == 2
    said = capsys.readouterr()
    expected = f"expected a device that torch finds here (cpu), got '{device}'"
    assert (said.out, said.err) == ("", f"nerd: {expected}\n")


@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_a_gpu_that_is_there_is_taken(device, one_gpu, capsys):
    argv = ["eval", "cartpole", "--dry-run", "--device"]
    assert main([*argv, device]) == 0
    assert main([*argv, "cuda:1"]) == 2
    assert "(cpu, cuda, cuda:0), got 'cuda:1'" in capsys.readouterr().err


@each_command
def test_the_work_is_sent_to_the_gpu(command, prepared, one_gpu, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    with pytest.raises(SentAwayError):
        main([command, *SMALL[command].split(), "--device", "cuda"])


@pytest.mark.gpu
@each_command
def test_the_gpu_does_what_the_processor_does(command, prepared, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert main([command, *SMALL[command].split(), "--device", "cuda"]) == 0
