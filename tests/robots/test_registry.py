"""Robots that a user registers: found by name everywhere, and refused in a sentence."""

import copy
import importlib
import os
import sys
from collections.abc import Iterator
from dataclasses import replace

import gymnasium
import pytest

from torchrl_nerd import load_scene
from torchrl_nerd.checkpoint import PRETRAINED, model_folder, shipped_models
from torchrl_nerd.cli import main
from torchrl_nerd.configs import PPOConfig
from torchrl_nerd.evaluation.policy import POLICIES, shipped_policies
from torchrl_nerd.gymnasium import gymnasium_id
from torchrl_nerd.robots import PRESETS, make_task, preset_of, register, task_id
from torchrl_nerd.robots.registry import (
    NOT_LOADED,
    TABLES,
    TASKS,
    VARIABLE,
    load_named_robots,
)
from torchrl_nerd.robots.robot import Robot

CART = replace(load_scene("cartpole"), name="cart")


class Stay(type(make_task("cartpole/swingup"))):
    """The swing-up of a cart that a user has."""

    def build_scene(self):
        return CART


ROBOT = Robot(
    scenes={"cart": lambda: CART},
    tasks={"cart/stay": Stay},
    presets={"cart": PRESETS["cartpole"]},
    ppo={"cart/stay": PPOConfig()},
    models={"cart": PRETRAINED / "cartpole"},
    policies={"cart/stay": POLICIES / "cartpole-swingup"},
)


KNOWN = "stay", "wait"
TOSSES = dict.fromkeys(("tasks", "presets", "ppo", "policies"), {})
TOSSES |= {"scenes": {"cube_tosses": lambda: CART}, "models": {"cube_tosses": "runs"}}


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    """Leave all tables, and Gymnasium's registry, as they were."""
    kept, ids = {field: copy.copy(table) for field, table in TABLES.items()}, set()
    ids |= set(gymnasium.registry)
    yield
    for field, table in TABLES.items():
        table.clear()
        table.update(kept[field])
    for name in set(gymnasium.registry) - ids:
        del gymnasium.registry[name]


def test_a_registered_robot_is_found_by_its_names():
    register(ROBOT)
    assert load_scene("cart") is CART and isinstance(make_task("cart/stay"), Stay)
    assert task_id(make_task("cart/stay")) == "cart/stay"
    assert preset_of("cart") is PRESETS["cartpole"]
    assert (
        "cart" in shipped_models() and model_folder("cart") == PRETRAINED / "cartpole"
    )
    assert shipped_policies()["cart/stay"] == POLICIES / "cartpole-swingup"
    assert gymnasium_id("cart/stay") in gymnasium.registry


def test_folders_that_are_not_there_yet_are_no_models(tmp_path):
    register(
        replace(ROBOT, models={"cart": tmp_path}, policies={"cart/stay": tmp_path})
    )
    assert "cart" not in shipped_models() and "cart/stay" not in shipped_policies()


def test_a_name_is_given_once_and_a_refused_robot_leaves_nothing():
    register(ROBOT)
    with pytest.raises(ValueError, match="'cart' is among the scenes of another robot"):
        register(ROBOT)
    other = {"scenes": {"one": lambda: CART, "ant": lambda: CART}}
    with pytest.raises(ValueError, match="'ant' is among the scenes of another robot"):
        register(Robot(**other))
    with pytest.raises(ValueError, match="unknown scene 'one'"):
        load_scene("one")


SOURCE = """from dataclasses import replace
from torchrl_nerd import load_scene
from torchrl_nerd.robots import make_task, register
from torchrl_nerd.robots.robot import Robot

def cart():
    return replace(load_scene("cartpole"), name="cart")

class Stay(type(make_task("cartpole/swingup"))):
    horizon = {horizon}
    def build_scene(self):
        return cart()

register(Robot(scenes={{"cart": cart}}, tasks={{"cart/stay": Stay}}))
"""


def test_a_module_that_is_loaded_again_replaces_its_robot(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    path = tmp_path / "my_cart_again.py"
    path.write_text(SOURCE.format(horizon=100))
    module = importlib.import_module(path.stem)
    path.write_text(SOURCE.format(horizon=1000))
    importlib.reload(module)
    assert make_task("cart/stay").horizon == 1000
    assert gymnasium.registry[gymnasium_id("cart/stay")].max_episode_steps == 1000
    with pytest.raises(ValueError, match="'cart' is among the scenes of another robot"):
        register(ROBOT)
    path.write_text(SOURCE.format(horizon=100).replace("cart/stay", "cart/wait"))
    importlib.reload(module)
    assert make_task("cart/wait").horizon == 100
    assert [task for task in TASKS if task.startswith("cart/")] == ["cart/wait"]
    known = [gymnasium_id(f"cart/{task}") in gymnasium.registry for task in KNOWN]
    assert known == [False, True]


def test_robots_that_share_a_scene_s_name_in_turn_leave_each_other_alone():
    """What a scene was once registered with is forgotten once it is dropped."""
    names = {name: _named(name) for name in ("arm", "leg")}
    register(Robot(scenes=names))
    register(Robot(scenes={"arm": names["arm"]}))
    register(Robot(scenes={"leg": names["leg"]}))
    assert {"arm", "leg"} <= TABLES["scenes"].keys()


def _named(name):
    """A function of this module, as registering again asks for."""
    function = lambda: CART  # noqa: E731
    function.__qualname__ = function.__name__ = name
    return function


BAD = [
    (ValueError, "'cube_tosses' is a model of the package", TOSSES),
    (TypeError, "expected a Robot to register, got dict", {}),
    (TypeError, "that return a Scene as scenes", {"scenes": {"cart": CART}}),
    (TypeError, "names and functions", {"scenes": [CART]}),
    (TypeError, "subclasses of Task as tasks", {"tasks": {"cart/stay": "Stay"}}),
    (TypeError, "a Preset as presets", {"presets": {"cart": PPOConfig()}}),
    (TypeError, "a PPOConfig as ppo", {"ppo": {"cart/stay": {}}}),
    (TypeError, "a folder as models", {"models": {"cart": 3}}),
    (TypeError, "a folder as policies", {"policies": {"cart/stay": None}}),
    (
        ValueError,
        "no kind of dynamics .*, got 'my/cart'",
        {"scenes": {"my/cart": Stay}},
    ),
    (
        ValueError,
        "no kind of dynamics .*, got 'cart.xml'",
        {"scenes": {"cart.xml": Stay}},
    ),
    (ValueError, "without / or .xml .*, got none", {"scenes": {}}),
    (ValueError, "no kind of dynamics .*, got 'nerd'", {"scenes": {"nerd": Stay}}),
    (ValueError, r"SCENE/TASK of its scenes \(cart\)", {"tasks": {"stay": Stay}}),
    (ValueError, "as tasks, got 'ant/stay'", {"tasks": {"ant/stay": Stay}}),
    (ValueError, "as models, got 'ant-mlp'", {"models": {"ant-mlp": "runs"}}),
    (ValueError, "as presets, got 'ant'", {"presets": {"ant": PRESETS["ant"]}}),
    (ValueError, r"its tasks \(cart/stay\) as ppo", {"ppo": {"ant/run": PPOConfig()}}),
    (ValueError, "as policies, got 'cart/go'", {"policies": {"cart/go": "runs"}}),
]


@pytest.mark.parametrize(("error", "message", "changes"), BAD)
def test_what_is_no_robot_is_refused_in_a_sentence(error, message, changes):
    before = {field: copy.copy(table) for field, table in TABLES.items()}
    with pytest.raises(error, match=message) as caught:
        register(replace(ROBOT, **changes) if changes else vars(ROBOT))
    assert "\n" not in str(caught.value)
    assert before == TABLES


def test_a_scene_with_a_dash_in_its_name_has_tasks_and_models(tmp_path):
    name, models = "my-cart", {"my-cart": tmp_path, "my-cart-mlp": tmp_path}
    scene = replace(CART, name=name)
    register(Robot({name: lambda: scene}, {f"{name}/stay": Stay}, models=models))
    assert load_scene(name) is scene and model_folder("my-cart-mlp") == tmp_path


def test_what_builds_something_else_is_refused_when_it_is_asked_for():
    scenes = {"cart": lambda: CART, "pole": lambda: CART, "empty": dict}
    register(Robot(scenes=scenes, tasks={"cart/no": dict}))
    with pytest.raises(ValueError, match="Scene with the name 'pole', got 'cart'"):
        load_scene("pole")
    with pytest.raises(ValueError, match="Scene with the name 'empty', got {}"):
        load_scene("empty")
    with pytest.raises(ValueError, match="Task by the id 'cart/no', got {}"):
        make_task("cart/no")


def test_the_commands_take_its_names(capsys):
    register(ROBOT)
    assert main(["transfer", "cart/stay", "--episodes", "4", "--quiet"]) == 0
    assert "learned" in capsys.readouterr().out
    assert main(["data", "cart", "--dry-run"]) == 0
    count = PRESETS["cartpole"].data.trajectories
    assert f"draw {count} trajectories of cart," in capsys.readouterr().out


def test_entries_that_fail_are_told_where_a_name_is_unknown(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "broken.py").write_text("from torchrl_nerd import nothing_like_this")
    (tmp_path / "dull.py").write_text(
        "from torchrl_nerd.robots import register as r; r(1)"
    )
    (tmp_path / "sound.py").write_text("LOADED = True")
    (tmp_path / "random.py").write_text("raise RuntimeError")
    entries = (
        "nowhere",
        "broken.py",
        str(tmp_path / "dull.py"),
        "sound.py",
        "random.py",
    )
    monkeypatch.setenv(VARIABLE, os.pathsep.join(entries))
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.chdir(tmp_path)
    load_named_robots()
    assert sys.modules.pop("sound").LOADED and len(NOT_LOADED) == 4
    assert main(["explain", "cart"]) == 2
    said = capsys.readouterr().err
    NOT_LOADED.clear()
    assert said.count("\n") == 1 and "unknown scene 'cart'" in said
    assert "names 'nowhere', which fails with ModuleNotFoundError" in said
    assert "names 'broken.py', which fails with ImportError" in said
    assert "TypeError: expected a Robot to register, got int" in said
    assert "names 'random.py', which fails with ImportError: another module" in said
