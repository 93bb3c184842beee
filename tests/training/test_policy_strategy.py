"""Data along a saved policy: its own way, to the same bits whenever it is cut short."""

import json

import pytest
import torch

from torchrl_nerd.cli import main
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data import generate as module
from torchrl_nerd.data.generate import generate, load_data
from torchrl_nerd.evaluation.policy import Policy, load_policy, make_actor, save_policy
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import load_scene, make_task
from torchrl_nerd.seeds import fold_in
from torchrl_nerd.training.policy_data import along_policies, policy_data

TASK = "cartpole/swingup"
SCENE = load_scene("cartpole")
CONFIG = DataConfig(trajectories=10, steps=4, seed=3)
CHUNK = 4


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch):
    monkeypatch.setattr(module, "CHUNK", CHUNK)


@pytest.fixture
def folder(tmp_path, seed):
    return save_policy(Policy((4, 8, 1)), tmp_path / "policy", {"task": TASK})


def test_it_draws_what_the_policy_does(folder, tmp_path):
    strategy = along_policies(SCENE, [folder], noise=0.2)
    data = load_data(SCENE, generate(SCENE, CONFIG, tmp_path / "d", True, strategy))
    task = make_task(TASK)
    actor = make_actor(load_policy(folder, task))
    for chunk, rows in enumerate((4, 4, 2)):
        generator = fold_in(CONFIG.seed, chunk)
        expected = policy_data(task, actor, rows, CONFIG.steps, generator, 0.2)
        found = data[chunk * CHUNK : chunk * CHUNK + rows]
        for key in expected.keys(True, True):
            assert torch.equal(found[key], expected[key]), key


def test_several_policies_share_the_trajectories(folder, tmp_path):
    folders = folder, save_policy(Policy((4, 8, 1)), tmp_path / "b", {"task": TASK})
    argv = ["data", "cartpole", "--policy", *map(str, folders), "--seed", "3"]
    argv += ["--trajectories", "8", "--steps", "4", "--quiet"]
    assert main([*argv, "--out", str(tmp_path / "d")]) == 0
    assert read_json(tmp_path / "d" / "data.json")["strategy"].startswith("2 policies ")
    data, task = load_data(SCENE, tmp_path / "d"), make_task(TASK)
    actors = [make_actor(load_policy(folder, task)) for folder in folders]
    for chunk in range(2):
        generator = fold_in(3, chunk)
        for half, actor in enumerate(actors):
            expected = policy_data(task, actor, 2, 4, generator)
            first = chunk * CHUNK + 2 * half
            assert torch.equal(data[first : first + 2]["qpos"], expected["qpos"])


def test_a_set_cut_short_goes_on_to_the_same_bits(folder, tmp_path):
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    generate(SCENE, CONFIG, whole, True, along_policies(SCENE, [folder]))
    name, draw = along_policies(SCENE, [folder])
    calls = iter(range(2))

    def dying(rows, steps, generator):
        if next(calls) == 1:
            raise KeyboardInterrupt
        return draw(rows, steps, generator)

    with pytest.raises(KeyboardInterrupt):
        generate(SCENE, CONFIG, cut, True, (name, dying))
    assert read_json(cut / "data.json")["chunks_done"] == 1
    generate(SCENE, CONFIG, cut, True, along_policies(SCENE, [folder]))
    data, expected = load_data(SCENE, cut), load_data(SCENE, whole)
    assert all(torch.equal(data[k], expected[k]) for k in expected.keys(True, True))


def test_another_policy_or_noise_is_refused(folder, tmp_path):
    out, copy = tmp_path / "d", tmp_path / "copy"
    generate(SCENE, CONFIG, out, True, along_policies(SCENE, [folder]))
    save_policy(load_policy(folder), copy, {"task": TASK})  # the same one elsewhere
    generate(SCENE, CONFIG, out, True, along_policies(SCENE, [copy]))
    other = save_policy(Policy((4, 8, 1)), tmp_path / "other", {"task": TASK})
    for strategy in (
        along_policies(SCENE, [other]),
        along_policies(SCENE, [folder], 0.4),
    ):
        with pytest.raises(ValueError, match=f"{out} already holds data with strategy"):
            generate(SCENE, CONFIG, out, True, strategy)


def test_the_command_takes_the_task_from_the_card(folder, tmp_path, capsys):
    argv = ["data", "cartpole", "--policy", str(folder), "--out", str(tmp_path / "d")]
    argv += ["--trajectories", "6", "--steps", "3", "--quiet"]
    assert main([*argv, "--dry-run"]) == 0
    assert "draw 6 trajectories of cartpole" in capsys.readouterr().out
    assert main(argv) == main(argv) == 0
    card = read_json(tmp_path / "d" / "data.json")
    assert card["strategy"].startswith("policy ") and card["trajectories"] == 6


@pytest.mark.parametrize(
    ("argv", "card", "words"),
    [
        ("ant", {}, "acts in scene 'cartpole'"),
        ("cartpole --reference rk4", {}, "acts in scene 'cartpole'"),
        ("cartpole --noise -0.1", {}, "noise of at least 0.0, got -0.1"),
        ("cartpole", {"task": 3}, "expected the task's id in"),
        ("cartpole", {"task": "cartpole/fly"}, "unknown task 'cartpole/fly'"),
        ("cartpole", {"sizes": [5, 8, 1]}, "has 5 observations"),
        ("cartpole --from tosses.npz", {}, "expected"),
    ],
)
def test_what_cannot_be_followed_is_refused(
    argv, card, words, folder, tmp_path, capsys
):
    path = folder / "policy.json"
    path.write_text(json.dumps(read_json(path) | card))
    argv = ["data", *argv.split(), "--policy", str(folder)]
    assert main([*argv, "--out", str(tmp_path / "d")]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not (tmp_path / "d").exists()


def test_a_folder_without_a_policy_is_refused(tmp_path, capsys):
    assert main(["data", "cartpole", "--policy", str(tmp_path / "none")]) == 2
    assert "found no policy" in capsys.readouterr().err


def test_varied_robots_follow_it_each_with_its_own_parameters(folder, tmp_path):
    scene = SCENE.vary({"mass:pole": (0.3, 3.0)})
    strategy = along_policies(scene, [folder])
    data = load_data(scene, generate(scene, CONFIG, tmp_path / "d", True, strategy))
    masses = data["parameters"][:, 0, 0]
    assert masses.min() >= 0.3 and masses.max() <= 3.0 and masses.std() > 0.1
