"""Data drawn by Ray's workers, some of which are killed: the same bits as without Ray."""

import logging
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from torchrl_nerd.cli import main
from torchrl_nerd.configs import DataConfig
from torchrl_nerd.data import generate as module
from torchrl_nerd.data.cluster import ray_map
from torchrl_nerd.data.generate import generate, load_data, simulate
from torchrl_nerd.dynamics import MujocoDynamics
from torchrl_nerd.files import read_json
from torchrl_nerd.robots import load_scene

ray = pytest.importorskip("ray")
SCENE = load_scene("double_pendulum")
CONFIG = DataConfig(trajectories=22, steps=4)


@pytest.fixture(scope="module")
def cluster():
    """One node of one processor; its workers get as much of it as the test itself."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_worker_niceness", "0")
        ray.init("local", num_cpus=1, log_to_driver=False, logging_level=logging.ERROR)
        yield
        ray.shutdown()


@pytest.fixture
def small_chunks(monkeypatch):
    monkeypatch.setattr(module, "CHUNK", 4)


def dying_draw(folder: Path, is_deadly: bool):
    """`simulate`, but whoever first draws the last chunk's 2 rows is killed in it."""

    def draw(rows, steps, generator):
        data = simulate(SCENE, rows, steps, generator)
        if is_deadly and rows == 2 and not list(folder.iterdir()):
            (folder / str(os.getpid())).touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return data

    return draw


@pytest.mark.slow
def test_a_killed_worker_changes_no_bit(cluster, small_chunks, tmp_path, seed):
    deaths = tmp_path / "deaths"
    deaths.mkdir()
    config = replace(CONFIG, seed=seed)
    sets, cards = [], []
    for mapper, is_deadly in ((map, False), (ray_map, True)):
        strategy = "dying", dying_draw(deaths, is_deadly)
        folder = tmp_path / mapper.__name__
        generate(SCENE, config, folder, True, strategy, mapper)
        sets.append(load_data(SCENE, folder))
        cards.append(read_json(folder / "data.json"))
    (killed,) = deaths.iterdir()
    assert int(killed.name) != os.getpid()
    assert cards[0] == cards[1] and len(sets[0]) == 22 - cards[0]["dropped"]
    keys = set(sets[0].keys(True, True))
    assert keys == set(sets[1].keys(True, True)) and len(keys) > 4
    assert all(torch.equal(sets[0][key], sets[1][key]) for key in keys)


def test_a_set_begun_here_is_finished_by_ray(
    cluster, small_chunks, tmp_path, seed, monkeypatch
):
    config = replace(CONFIG, seed=seed)

    def two(function, chunks):
        yield from map(function, chunks[:2])
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generate(SCENE, config, tmp_path / "set", True, mapper=two)
    assert read_json(tmp_path / "set" / "data.json")["chunks_done"] == 2
    generate(SCENE, config, tmp_path / "set", True, mapper=ray_map)
    found = load_data(SCENE, tmp_path / "set")
    whole = load_data(SCENE, generate(SCENE, config, tmp_path / "whole", True))
    assert all(torch.equal(found[k], whole[k]) for k in whole.keys(True, True))


def test_results_come_in_order_and_threads_are_one(cluster):
    def visit(item: int) -> tuple[int, int]:
        return item, MujocoDynamics(SCENE).num_threads

    assert list(ray_map(visit, range(7))) == [(item, 1) for item in range(7)]
    assert list(ray_map(visit, [])) == []


def test_what_goes_wrong_in_a_worker_is_said_here(cluster):
    def refuse(item: int) -> None:
        raise ValueError(f"expected another number, got {item}")

    with pytest.raises(ValueError, match="^expected another number, got 3$"):
        list(ray_map(refuse, [3]))


def test_the_command_takes_a_cluster(cluster, tmp_path, capsys):
    argv = ["data", "cartpole", "--trajectories", "3", "--steps", "2", "--quiet"]
    assert main([*argv, "--out", str(tmp_path), "--ray", "auto"]) == 0
    assert len(load_data(load_scene("cartpole"), tmp_path)) == 3


def test_where_ray_is_missing_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.setattr("torchrl_nerd.data.cluster.find_spec", lambda name: None)
    argv = ["data", "cartpole", "--trajectories", "3", "--out", str(tmp_path / "d")]
    assert main([*argv, "--quiet", "--ray", "local"]) == 2
    said = capsys.readouterr().err
    assert said == (
        "nerd: this needs the package ray, which is not installed: "
        "in the clone, pip install -e '.[ray]'\n"
    )


def test_threads_come_from_the_environment(monkeypatch):
    monkeypatch.setenv("NERD_THREADS", "3")
    assert MujocoDynamics(SCENE).num_threads == 3
    assert MujocoDynamics(SCENE, num_threads=2).num_threads == 2
    monkeypatch.delenv("NERD_THREADS")
    assert MujocoDynamics(SCENE).num_threads == os.cpu_count()
    for bad in ("0", "-1", "many"):
        monkeypatch.setenv("NERD_THREADS", bad)
        with pytest.raises(ValueError, match=f"NERD_THREADS to be a number.*'{bad}'"):
            MujocoDynamics(SCENE)
