"""The page on a robot of one's own: its files and commands, as a reader would run them."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "own_robot.md"
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```", PAGE.read_text(), re.M | re.S)
SCRIPT = '''"""All commands and all code after the robot's own files, in order."""
import gymnasium, shlex, sys
from torchrl.envs import ParallelEnv
from torchrl_nerd import load_scene, make_env
from torchrl_nerd.cli import main


def worker():
    return make_env("arm/reach", dynamics="nerd", num_envs=2, seed=0)


if __name__ == "__main__":
    for language, text in {blocks!r}:
        if language == "py":
            exec(text, {{}})
        for line in text.splitlines() if language == "sh" else ():
            if line.startswith("nerd "):
                assert main(shlex.split(line)[1:]) == 0, line
    assert load_scene("arm").name == "arm"
    if not {is_whole}:
        sys.exit()
    env = ParallelEnv(1, worker, mp_start_method="spawn")
    print("workers", tuple(env.rollout(3)["next", "goal"].shape))
    env.close()
'''


# By default the robot is found by its name alone: tutorials/own_robot.ipynb, which
# test_tutorials.py runs, leads from a file to a model as well.
@pytest.mark.parametrize(
    "is_whole", [False, pytest.param(True, marks=pytest.mark.slow)]
)
def test_the_page_leads_from_a_file_to_a_registered_robot(is_whole, tmp_path):
    (_, mjcf), (_, module), *later = BLOCKS
    (tmp_path / "arm.xml").write_text(mjcf)
    (tmp_path / "my_arm.py").write_text(module)
    assert ("sh", "export NERD_ROBOTS=$PWD/my_arm.py\n") in later
    first = ("sh", "nerd explain arm\n")
    assert any(text.startswith(first[1]) for _, text in later)
    blocks = later if is_whole else [first]
    # not named as the package's modules are: it lies elsewhere and knows no path to it
    (tmp_path / "run.py").write_text(SCRIPT.format(blocks=blocks, is_whole=is_whole))
    env = {**os.environ, "NERD_ROBOTS": str(tmp_path / "my_arm.py")}
    env["PYTHONPATH"] = os.pathsep.join((str(PAGE.parents[2]), *sys.path))
    command = [sys.executable, "run.py"]
    done = subprocess.run(
        command, cwd=tmp_path, env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    said = done.stdout
    assert said.startswith("arm: 10 features a step")
    if not is_whole:
        return
    assert "arm-mlp" in said and "workers (1, 2, 3, 3)" in said
    assert re.search(r"^nerd +learned +arm-mlp +16", said, re.M)
    assert (tmp_path / "runs" / "arm" / "best" / "card.json").is_file()
