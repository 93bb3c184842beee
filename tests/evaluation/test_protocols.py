"""Every robot is measured as in the paper, beside the results that the paper prints."""

import pytest
import torch

from torchrl_nerd.configs import NO_PREDICTIONS
from torchrl_nerd.evaluation.rollout_error import UNSEEN, initial_states, scene_of
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.modules.networks import NETWORKS, network_config
from torchrl_nerd.robots import (
    PRESETS,
    SCENES,
    TASKS,
    load_scene,
    make_task,
    preset_of,
    protocol_of,
    source_of,
)
from torchrl_nerd.seeds import fold_in

CARTPOLE = """
                        100     500     1000
    slider              0.0002  0.004   0.033
    hinge               0.0004  0.013   0.075
"""  # Fig. 3: base position (m), non-base joint (rad)
DOUBLE_PENDULUM = """
            0      1      2      3      4      5      6
    joint1  0.004  0.012  0.008  0.005  0.011  0.029  0.008
    joint2  0.007  0.015  0.011  0.011  0.018  0.056  0.013
"""  # appendix C.2, rad, 100 steps; 0 is no ground in reach


def table(text: str) -> dict[tuple[int, str], float]:
    """(column, row) -> entry."""
    head, *rows = (line.split() for line in text.strip().splitlines())
    return {
        (int(column), name): float(entry)
        for name, *entries in rows
        for column, entry in zip(head, entries, strict=True)
    }


def test_every_scene_has_a_protocol_and_presets_are_of_scenes():
    assert set(PRESETS) == set(SCENES) >= set(PRESETS)


def test_protocols_fit_their_scene(scene):
    protocol = PRESETS[scene.name].protocol
    names = {scene.model.joint(i).name for i in range(scene.model.njnt)}
    if scene.base.is_floating:
        names = {"base_position", "base_orientation", "joints"}
    assert protocol.cases and protocol.horizons
    assert list(protocol.horizons) == sorted(set(protocol.horizons))
    assert all(scene_of(source) is scene for source in protocol.cases.values())
    assert set(protocol.random_actions) <= set(protocol.cases)
    assert protocol_of(scene).cases.keys() == protocol.cases.keys()
    for (case, horizon, quantity), figure in protocol.published.items():
        assert case in protocol.cases and horizon in protocol.horizons
        assert quantity in names and 0.0 < figure < 1.0


@pytest.mark.parametrize("name", PRESETS)
def test_presets_fit_their_scene(name):
    preset = PRESETS[name]
    assert preset.task in TASKS and make_task(preset.task).scene is load_scene(name)
    network = network_config(preset.train.network)
    assert NeRD(load_scene(name), NO_PREDICTIONS, network).token_size > 0
    assert preset.data.steps >= max(
        preset.train.sequence_length, preset.train.rollout_length
    )


def test_published_results_of_the_cartpole():
    expected = {("passive", *key): value for key, value in table(CARTPOLE).items()}
    assert len(expected) == 6
    assert PRESETS["cartpole"].protocol.published == expected


def test_published_results_of_the_double_pendulum():
    expected = {
        (f"terrain {ground}", 100, joint): value
        for (ground, joint), value in table(DOUBLE_PENDULUM).items()
    }
    assert len(expected) == 14
    assert PRESETS["double_pendulum"].protocol.published == expected


def test_published_results_of_the_ant():
    protocol = PRESETS["ant"].protocol
    assert protocol.horizons == (100, 500) and not protocol.random_actions
    assert protocol.published == {
        ("passive", 500, "base_position"): 0.057,
        ("passive", 500, "base_orientation"): 0.095,
        ("passive", 500, "joints"): 0.077,
    }


def test_arms_are_driven_and_no_other_robot_is():
    driven = {name for name in PRESETS if PRESETS[name].protocol.random_actions}
    assert driven == {"franka", "franka_gravity"}


@pytest.mark.parametrize(
    ("name", "cases"),
    [
        ("dm_control/cheetah-run", ["passive", "random"]),
        ("dm_control/walker-walk", ["passive", "random"]),
        ("gymnasium/Swimmer-v5", ["passive", "random"]),
    ],
)
def test_third_party_robots_start_within_their_own_ranges(name, cases, seed):
    scene = load_scene(name)
    protocol, preset = protocol_of(scene), preset_of(name)
    assert list(protocol.cases) == cases and not protocol.published
    assert protocol.random_actions == ("random",)
    assert source_of(scene) is scene and preset.train.network in NETWORKS
    start = initial_states(scene, 20, seed)
    expected, _ = scene.sample_initial(20, fold_in(seed, UNSEEN))
    assert all(torch.equal(start[key], value) for key, value in expected.items())
