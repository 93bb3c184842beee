"""The ``nerd`` command: data to results, and bad input in one sentence."""

import json
import math
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import pytest
from helpers import EXCERPT, slow_but

from torchrl_nerd import __version__
from torchrl_nerd.checkpoint import from_pretrained
from torchrl_nerd.cli import COMMANDS, main
from torchrl_nerd.cli.options import varied_ranges
from torchrl_nerd.configs import DataConfig, FinetuneConfig
from torchrl_nerd.data import generate as generate_module
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.bench.candidates import mujoco_name, simulators
from torchrl_nerd.evaluation.bench.errors import PAPER, cases_of
from torchrl_nerd.evaluation.results import read_results
from torchrl_nerd.evaluation.rollout_error import passive_errors
from torchrl_nerd.evaluation.stability.cases import CASES
from torchrl_nerd.files import folder_name
from torchrl_nerd.robots import PRESETS, SCENES, load_scene, preset_of, protocol_of

NOTHING_RANDOM = ("doctor", "explain")
SOON_DONE = ("explain",)
QUICK = ("cube",)  # the others take minutes in all
TINY = [
    "--network",
    "mlp-4x64",
    "--batch-size",
    "64",
    "--rollout-batch-size",
    "8",
    "--quiet",
]


def refusal(capsys, *argv: str) -> str:
    """The one sentence that a refused command leaves."""
    try:
        status = main(list(argv))
    except SystemExit as stop:
        status = stop.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.err.startswith("nerd: ") and captured.err.count("\n") == 1
    return captured.err


def assert_finite(content) -> None:
    if isinstance(content, dict):
        content = list(content.values())
    if isinstance(content, list):
        for entry in content:
            assert_finite(entry)
    elif isinstance(content, float):
        assert math.isfinite(content)


def read(path) -> dict:
    content = json.loads(path.read_text())
    assert_finite(content)
    return content


@pytest.mark.parametrize("argv", [[], ["--help"], ["-h"]])
def test_help_names_every_command(argv, capsys):
    assert main(argv) == 0
    text = capsys.readouterr().out
    assert set(COMMANDS) >= {"data", "train", "eval"}
    assert all(f"  {name}" in text for name in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main([command, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    assert f"Example: nerd {command} " in text
    assert "--json " in text and "--dry-run" in text
    assert ("--seed " in text) == (command not in NOTHING_RANDOM)
    assert ("--quiet" in text) == (command not in SOON_DONE)
    for mark in ("`", "STR", "INT", "FLOAT", "{None}", "default: )", "default: none"):
        assert mark not in text


@pytest.mark.parametrize("command", COMMANDS)
def test_help_explains_every_flag(command, capsys):
    with pytest.raises(SystemExit):
        main([command, "--help"])
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    options = [i for i, line in enumerate(lines) if re.match(r"--\w", line)]
    texts = [
        " ".join(lines[first:last]).partition("(default:")[0].split()
        for first, last in pairwise([*options, len(lines)])
    ]
    assert len(texts) >= 2
    for words in texts:  # more than names, types and choices
        told = [w for w in words if w.isalpha() and w.islower() and len(w) > 1]
        assert len(told) >= 2, words


def test_a_misspelt_command_is_told_the_nearest(capsys):
    assert "did you mean 'train'?" in refusal(capsys, "trian", "ant")


def test_a_hybrid_is_trained_where_the_preset_has_one(capsys):
    for name, preset in PRESETS.items():
        argv = ["train", name, "--kind", "hybrid", "--dry-run"]
        if preset.hybrid is None:
            assert "a scene whose preset has a hybrid" in refusal(capsys, *argv)
            continue
        assert main(argv) == 0
        text = capsys.readouterr().out
        assert f"runs/{name}-hybrid" in text and "weights of a hybrid model" in text
        assert f"for {preset.hybrid.total_steps} updates" in text
    assert any(preset.hybrid for preset in PRESETS.values())


def test_a_step_makes_any_model_a_hybrid(capsys):
    step = ["--step", "unconstrained", "--dry-run"]
    assert main(["train", "cartpole", "--kind", "hybrid", *step]) == 0
    assert "weights of a hybrid model" in capsys.readouterr().out
    assert "--kind hybrid" in refusal(capsys, "train", "cartpole", *step)


def test_the_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"nerd {__version__}\n"


@pytest.mark.parametrize("command", ["data", "train", "finetune"])
def test_help_shows_the_preset_of_the_scene(command, scene, capsys):
    preset = PRESETS[scene.name]
    with pytest.raises(SystemExit) as stop:
        main([command, scene.name, "--help"])
    text = capsys.readouterr().out
    assert stop.value.code == 0
    count = {
        "data": preset.data.trajectories,
        "train": preset.train.steps,
        "finetune": FinetuneConfig().evaluations,
    }[command]
    assert f"default: {count})" in " ".join(text.split())


@pytest.mark.parametrize(
    ("argv", "plan"),
    [
        ("data cartpole --trajectories 300 --steps 7", "draw 300 trajectories of"),
        ("train cartpole --network mlp-4x64", "begin a run in runs/cartpole"),
        ("train cartpole --reference rk4", "to datasets/cartpole-rk4"),
        ("eval cartpole --num-trajectories 77", "num_trajectories             77"),
        ("stability cube --cases resting", "('resting',)"),
        ("doctor --json out.json", "out.json"),
    ],
)
def test_a_dry_run_says_what_it_would_do_and_does_nothing(
    argv, plan, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert main([*argv.split(), "--dry-run"]) == 0
    assert plan in capsys.readouterr().out
    assert not any(tmp_path.iterdir())


def test_a_dry_run_sees_what_is_there(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    draw = "data cartpole --trajectories 8 --steps 20 --quiet".split()
    learn = "train cartpole --steps 1 --rollout-steps 1 --batch-size 2".split()
    learn += [
        "--sequence-length",
        "2",
        "--rollout-batch-size",
        "2",
        "--rollout-length",
        "2",
        "--quiet",
    ]
    assert main(draw) == main(learn) == main([*draw, "--dry-run"]) == 0
    assert "where 8 exist" in capsys.readouterr().out
    assert main([*learn, "--dry-run"]) == 0
    text = capsys.readouterr().out
    assert "use the data in datasets/cartpole" in text
    assert "resume the run in runs/cartpole" in text
    for dry in ([], ["--dry-run"]):
        assert "holds data with config.steps 20, asked for 30" in refusal(
            capsys, *draw[:-2], "30", *dry
        )
        assert "holds a run with config.seed 0" in refusal(
            capsys, *learn, "--seed", "5", *dry
        )
        typo = ["--data", "datasets/cartpol", "--out", "runs/other"]
        assert "a data set in datasets/cartpol" in refusal(capsys, *learn, *typo, *dry)
    shutil.rmtree("datasets")
    assert "holds a run" in refusal(capsys, *learn, "--seed", "5")
    assert not (tmp_path / "datasets").exists()  # nothing was drawn


@pytest.mark.parametrize("command", ["data", "train", "finetune"])
def test_a_dry_run_refuses_what_the_run_would(command, capsys):
    more = ["--from", str(EXCERPT)] if command == "finetune" else []
    assert "'unicorn'" in refusal(capsys, command, "unicorn", "--dry-run", *more)


@pytest.mark.parametrize("dry", [["--dry-run"], []])
@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ("eval unicorn", "'unicorn'"),
        ("eval cartpole --model nowhere", "'nowhere'"),
        ("eval cube --data {log} --seed 3", "expected --seed without --data"),
        ("eval cartpole --variants fast", "unknown variant 'fast'"),
        ("eval cube --data nowhere.npz", "nowhere.npz"),
        ("eval cube --data {log} --split tset", "'tset'"),
        ("bench cartpole --models nowhere", "'nowhere'"),
        ("transfer cartpole/swingup --dynamics nowhere", "'nowhere'"),
        ("play cartpole/swingup --dynamics nowhere", "'nowhere'"),
        ("finetune cube --from {log} --update head", "expected update 'physics'"),
        ("finetune cube --from {log} --batch-size 8", "expected no --batch-size for"),
        (
            "finetune cube --from {log} --model cube_real-mlp --evaluations 2",
            "expected no --evaluations for",
        ),
        ("bench unicorn", "'unicorn'"),
        ("bench cartpole --steps 0", "expected steps of at least 1, got 0"),
        ("stability unicorn", "'unicorn'"),
        ("stability cartpole --scale -4", "a scale in (0, 1], got -4.0"),
        ("transfer cartpole/fly", "'cartpole/fly'"),
        ("play cartpole/swingup --slowdown -1", "slowdown above 0, got -1.0"),
        ("play cartpole/swingup --policy x --actions zero", "or --actions, got both"),
        ("explain unicorn", "'unicorn'"),
        ("train cartpole --clip 0", "clip above 0, got 0"),
        ("train cartpole --lr inf", "lr of at least 0, got inf"),
        ("data cartpole --out {log}/x", "{log}"),
        ("finetune cube --from {log} --out {log}/x", "{log}"),
        ("explain cartpole --json {log}/x.json", "{log}"),
        ("train cartpole --threads 0", "threads of at least 1, got 0"),
        ("train cartpole --sequence-length 500", "at least 500 steps, got"),
        ("data cube --from {log} --trajectories 3", "--from without options that draw"),
        ("data cartpole --noise 0.1", "expected --noise with --policy"),
        ("stability cartpole --cases drop", "cases that apply to 'cartpole'"),
        ("train cartpole --steps 0 --rollout-steps 0", "rollout_steps of at least 1"),
        ("train cartpole --bf16-fraction 2", "bf16_fraction from 0 to 1, got 2"),
        ("data cube --from {log} --noise 0.3", "--from without options that draw"),
        ("data ant --policy x --strategy resting", "--strategy without --policy"),
        ("data cartpole --strategy level", "expected a strategy of correlated, rest"),
        ("finetune cube --from {log} --model nowhere", "'nowhere'"),
    ],
)
def test_bad_input_is_refused_with_and_without_a_dry_run(
    argv, said, dry, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    argv, said = (text.format(log=EXCERPT) for text in (argv, said))
    assert said in refusal(capsys, *argv.split(), *dry)


def test_a_robot_may_be_named_behind_what_takes_several_words(capsys):
    """It has its preset, and is no further word of that option."""
    vary = ["--vary", "mass:pole=0.3:3.0"]
    drawn = []
    for words in (["cartpole", *vary], [*vary, "cartpole"]):
        assert main(["data", *words, "--dry-run"]) == 0
        drawn.append(capsys.readouterr().out)
    assert drawn[0] == drawn[1] and "trajectories of cartpole" in drawn[0]
    argv = ["train", "--data", "X", "cartpole", "--dry-run"]
    assert "expected a data set in X, found" in refusal(capsys, *argv)


def test_a_range_beside_the_preset_counts():
    for vary in (("mass:pole=1:1", "preset"), ("preset", "mass:pole=1:1")):
        ranges = varied_ranges("cartpole", vary)
        assert ranges["mass:pole"] == (1.0, 1.0) and len(ranges) > 1


def test_an_unknown_command_is_refused(capsys):
    text = refusal(capsys, "fly")
    assert "'fly'" in text and "data, train, eval" in text


@pytest.mark.parametrize("command", ["data", "train", "eval", "explain"])
def test_an_unknown_scene_is_refused(command, capsys):
    text = refusal(capsys, command, "unicorn")
    assert "'unicorn'" in text and all(name in text for name in SCENES)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("data cartpole --trajectories -5", "trajectories of at least 1, got -5"),
        ("data cartpole --steps 0", "steps of at least 1, got 0"),
        ("data cube --from a.npz --policy p", "--from without options that draw"),
        ("train cartpole --steps -1", "steps of at least 0, got -1"),
        ("train cartpole --batch-size -8", "batch_size of at least 1, got -8"),
        ("train cartpole --network huge", "unknown network 'huge'"),
        ("train cartpole --save-every 0", "save_every of at least 1"),
        ("train cartpole --lr nan", "lr of at least 0, got nan"),
        ("eval cartpole --split test", "expected --data with --baselines, --split"),
        (
            "eval cube --data a.npz --reference rk4",
            "expected --reference without --data",
        ),
        (
            "eval cube --data a.npz --variants bf16",
            "expected --variants without --data",
        ),
        ("eval cube --data a.npz --history 5", "expected --history without --data"),
        ("eval cartpole --vary motor=0.5:2 motor=0.5:2", "expected 'motor' once"),
        ("eval cartpole --vary motor=0.5:2 motor=0.6:1", "expected 'motor' once"),
        ("eval cartpole --vary preset preset", "expected 'preset' once"),
        ("train cartpole --threads -1", "threads"),
        ("train cartpole --device nowhere", "nowhere"),
        ("eval cartpole --num-trajectories 1", "at least 2, got 1"),
        ("eval cartpole --num-trajectories -3", "at least 2, got -3"),
        ("eval cartpole --device nowhere", "nowhere"),
        ("eval cartpole --model nowhere", "unknown dynamics 'nowhere'"),
    ],
)
def test_bad_input_is_refused(argv, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    argv = argv.split()
    if argv[:2] == ["train", "cartpole"]:
        sizes = ["--trajectories", "8", "--steps", "20", "--out", "d", "--quiet"]
        assert main(["data", "cartpole", *sizes]) == 0
        argv += ["--data", "d", "--quiet"]
        capsys.readouterr()
    assert words in refusal(capsys, *argv)


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ("data cartpole --trajectories many", "many"),
        ("train cartpole --speed 3", "--speed"),
        ("eval", "Name of the robot"),
    ],
)
def test_what_cannot_be_read_is_pointed_at(argv, words, capsys):
    with pytest.raises(SystemExit) as stop:
        main(argv.split())
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert words in captured.err and captured.out == ""


@pytest.mark.parametrize("command", ["data", "train", "finetune"])
def test_a_folder_that_cannot_be_written_is_refused(command, tmp_path, capsys):
    place = tmp_path / "taken"
    place.write_text("not a folder")
    more = {
        "data": [],
        "train": ["--data", str(tmp_path / "d")],
        "finetune": ["--from", str(EXCERPT)],
    }[command]
    text = refusal(capsys, command, "cartpole", "--out", str(place), *more)
    assert str(place) in text
    assert place.read_text() == "not a folder"
    assert sorted(tmp_path.iterdir()) == [place]


@pytest.mark.parametrize(
    "argv",
    [
        "train cartpole --data nowhere else",
        "train cartpole --data d --steps 1 --sequence-length 30",
        "train cartpole --data d --export e --init-from cartpole-mlp --network gru",
        "finetune cartpole --from nowhere.npz",
        "finetune cube --from {log} --update all",
    ],
)
def test_a_refused_run_leaves_no_folder(argv, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    draw = "data cartpole --trajectories 8 --steps 20 --out d --quiet"
    assert main(draw.split()) == 0
    capsys.readouterr()
    refusal(capsys, *argv.format(log=EXCERPT).split())
    assert [x.name for x in tmp_path.iterdir()] == ["d"]


def test_control_c_is_one_sentence(monkeypatch, capsys):
    def stop(command) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(COMMANDS["doctor"], "run", stop)
    assert main(["doctor"]) == 130
    assert capsys.readouterr().err.startswith("nerd: interrupted")


def test_no_traceback_reaches_the_terminal():
    command = [sys.executable, "-m", "torchrl_nerd.cli", "data", "unicorn"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.count("\n") == 1 and done.stderr.startswith("nerd: unknown")


@pytest.mark.parametrize("name", slow_but(QUICK, SCENES))
def test_from_data_to_results(name, tmp_path, seed, capsys):
    scene = load_scene(name)
    data, run, best = (str(tmp_path / x) for x in ("data", "run", "best"))
    results = {x: tmp_path / f"{x}.json" for x in ("data", "train", "eval")}
    argv = ["data", name, "--out", data, "--trajectories", "300", "--steps", "20"]
    argv += ["--seed", str(seed), "--quiet", "--json", str(results["data"])]
    assert main(argv) == 0
    card = read(results["data"])
    assert card["trajectories"] + card["dropped"] == 300
    assert card["config"] == {"trajectories": 300, "steps": 20, "seed": seed}

    argv = ["train", name, "--data", data, "--out", run, "--export", best, *TINY]
    argv += ["--steps", "40", "--rollout-steps", "2", "--validate-every", "42"]
    assert main([*argv, "--json", str(results["train"])]) == 0
    assert read(results["train"])["training"]["steps_done"] == 42
    assert main(argv) == 0  # finished: nothing to do

    argv = ["eval", name, "--model", best, "--num-trajectories", "8", "--quiet"]
    argv += ["--seed", str(seed), "--variants", "bf16"]
    capsys.readouterr()
    assert main([*argv, "--json", str(results["eval"])]) == 0
    table = capsys.readouterr().out
    record, protocol = read_results(results["eval"]), PRESETS[name].protocol
    line = shlex.split(record["command"])
    assert line[:2] == ["nerd", "eval"] and set(line[2:]) == set(argv[1:]) - {"--quiet"}
    content, expected = record["results"], {c.name for c in simulators(scene)}
    assert (record["seed"], content["scene"]) == (seed, name)
    assert content["ground_truth"] == mujoco_name(scene) and mujoco_name(scene) in table
    quantities = scene.model.njnt
    if scene.base.is_floating:
        quantities = 2 + (scene.model.njnt > 1)  # base, its orientation, all joints
    for case, _, _ in cases_of(protocol):
        for horizon in protocol.horizons:
            assert re.search(rf"^ +case .*\b{case}\b", table, re.M)
            assert re.search(rf"^ +steps .*\b{horizon}\b", table, re.M)
            rows = [
                row
                for row in content["errors"]
                if (row["case"], row["steps"]) == (case, horizon)
            ]
            names = {row["name"] for row in rows}
            assert names - {PAPER} >= expected | {best}
            assert sum(row["name"] == best for row in rows) == quantities
            for row in rows:
                is_paper = row["name"] == PAPER
                for key in ("mean", "interval", "final", "p95"):  # null: it diverges
                    assert row[key] is None or row[key] >= 0.0
                if row["kind"] == "ground truth":
                    assert row["mean"] == row["final"] == row["p95"] == 0.0
                if is_paper:
                    key = (row["case"], row["steps"], row["quantity"])
                    assert row["mean"] == protocol.published[key]

    exact, rounded = (
        [row["mean"] for row in content["errors"] if row["name"] == model]
        for model in (best, f"{best}, bf16")
    )
    assert len(exact) == len(rounded) and exact != rounded


@pytest.mark.slow
def test_a_third_party_robot_from_data_to_results(tmp_path, seed, monkeypatch, capsys):
    """Default folders, whose names hold no slash; the preset and protocol of any robot."""
    monkeypatch.chdir(tmp_path)
    name, folder = "dm_control/cheetah-run", "dm_control-cheetah-run"
    sizes = ["--trajectories", "300", "--steps", "20", "--seed", str(seed), "--quiet"]
    assert main(["data", name, *sizes]) == 0
    argv = ["train", name, *TINY, "--steps", "150", "--rollout-steps", "2"]
    assert main([*argv, "--validate-every", "152", "--json", "train.json"]) == 0
    card = json.loads((tmp_path / "train.json").read_text())
    assert card["scene"] == name and card["training"]["single_step_fraction"] == 1.0
    assert set(card["validation_error"]) == {"20", "100"}
    for place in ("datasets", "runs"):
        assert [path.name for path in (tmp_path / place).iterdir()] == [folder]

    model = ["--model", f"runs/{folder}/best", "--num-trajectories", "8"]
    assert main(["eval", name, *model, "--json", "eval.json", "--quiet"]) == 0
    rows = read_results(tmp_path / "eval.json")["results"]["errors"]
    learned = [row for row in rows if row["kind"] == "learned"]
    assert {(row["case"], row["steps"]) for row in learned} == {
        (case, steps) for case in ("passive", "random") for steps in (20, 100)
    }
    assert len(learned) == 4 * load_scene(name).model.njnt
    capsys.readouterr()
    said = refusal(capsys, "eval", name)
    assert f"no learned model of '{name}' is shipped" in said


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("../../etc/passwd", "unknown scene '../../etc/passwd'"),
        ("dm_control/../../etc-passwd", "expected dm_control/DOMAIN-TASK/HOLD"),
        ("dm_control/..-passwd", "unknown domain"),
        ("gymnasium/../Ant-v5", "unknown environment '../Ant-v5'"),
        ("dm_control/cheetah-fly", "unknown task in 'dm_control/cheetah-fly'"),
        ("../nowhere.xml", "found none at ../nowhere.xml"),
    ],
)
@pytest.mark.parametrize("command", ["data", "train", "eval"])
def test_names_that_lead_elsewhere_are_refused(
    command, name, words, tmp_path, monkeypatch, capsys
):
    inside = tmp_path / "inside"
    inside.mkdir()
    monkeypatch.chdir(inside)
    assert words in refusal(capsys, command, name)
    assert list(tmp_path.rglob("*")) == [inside]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cartpole", "cartpole"),
        ("dm_control/cheetah-run", "dm_control-cheetah-run"),
        ("gymnasium/HalfCheetah-v5", "gymnasium-HalfCheetah-v5"),
        ("robots/my arm.xml", "robots-my-arm"),
        ("../../robot.xml", "robot"),
        ("/home/me/robot.v2.xml", "home-me-robot.v2"),
        (".xml", "robot"),
    ],
)
def test_names_of_robots_are_names_of_folders(name, expected):
    assert folder_name(name) == expected


def test_progress_is_shown_apart_from_the_table(short_rollouts, capsys):
    model = ["--model", "cube-mlp", "--num-trajectories", "2"]
    assert main(["eval", "cube", *model]) == 0
    shown = capsys.readouterr()
    assert "cube:" in shown.err and "it/s" in shown.err
    assert main(["eval", "cube", *model, "--quiet"]) == 0
    assert capsys.readouterr() == (shown.out, "")


@pytest.mark.parametrize("name", slow_but(("ant", "cube", "anymal"), SCENES))
def test_a_scene_is_explained(name, tmp_path, capsys):
    scene = load_scene(name)
    path = tmp_path / "results.json"
    assert main(["explain", scene.name, "--json", str(path)]) == 0
    text, content = capsys.readouterr().out, read(path)
    assert text.startswith(f"{scene.name}: {content['token_width']} features a step")
    assert all(feature["key"] in text for feature in content["features"])
    counts = ", ".join(map(str, content["symmetries"]))
    assert f"symmetries of a network: {counts}" in text
    assert (content["symmetries"] == [1]) == bool(content["why_no_symmetries"])
    most = max(content["symmetries"] + content["near_symmetries"])
    assert ("--symmetries" in text) == (most > 1)
    assert ("--near-symmetry" in text) == (content["near_symmetries"] != [1])
    assert content["near_symmetries"] == ([1, 2, 4] if scene.name == "anymal" else [1])
    known = {"ant": [1, 2, 4], "cube": [1, 2, 4, 8], "anymal": [1], "cartpole": [1, 2]}
    assert content["symmetries"] == known.get(scene.name, content["symmetries"])


def test_the_shipped_cartpole_is_as_good_as_the_paper(seed):
    model, protocol = from_pretrained("cartpole"), protocol_of(load_scene("cartpole"))
    source, mujoco = protocol.cases["passive"], MujocoDynamics(model.scene)
    found = passive_errors(source, NeRDDynamics(model), mujoco, [100], 64, seed)[100]
    for quantity in ("slider", "hinge"):
        published = protocol.published["passive", 100, quantity]
        assert 0.0 < found[quantity].mean < 2.0 * published


@pytest.mark.parametrize(
    "name", slow_but(["analytic"], ["analytic", "nerd", "cartpole-mlp"])
)
def test_a_model_has_the_same_names_in_all_commands(name, short_rollouts, capsys):
    quick = ["--scale", "0.01", "--cases", next(iter(CASES)), "--quiet"]
    for argv in (
        ["eval", "cube", "--num-trajectories", "2", "--model", name, "--quiet"],
        ["stability", "cube", "--model", name, *quick],
    ):
        assert main(argv) == 0
        kind = from_pretrained(name, load_scene("cube")).kind
        assert kind in capsys.readouterr().out


@pytest.mark.parametrize(
    "line",
    [
        "eval cartpole --num-trajectories 4 --json {}",
        "transfer cartpole/swingup --episodes 4 --json {}",
        "explain cartpole --json {}",
        "play cartpole/swingup --steps 2 --json out.json --out {}.gif",
        "train cartpole --steps 0 --rollout-steps 2 --export {}",
    ],
)
def test_where_results_cannot_go_is_said_before_any_work(
    line, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    said = refusal(capsys, *line.format("file/results").split())
    assert "file/results" in said and "Not a directory" in said
    assert not (tmp_path / "datasets").exists()  # train would draw them first


def test_results_do_not_replace_a_folder(tmp_path, capsys):
    said = refusal(capsys, "explain", "cartpole", "--json", str(tmp_path))
    assert f"{tmp_path} cannot be written: Is a directory" in said


@pytest.mark.parametrize("scene", ["cartpole", "gymnasium/Reacher-v5"])
@pytest.mark.parametrize("order", ["{0} {1}", "{1} {0}", "--quiet {0} {1}"])
def test_the_preset_is_that_of_the_scene_and_not_of_a_folder(scene, order, capsys):
    """``ant`` is a scene with a preset of its own, and the name of a folder here."""
    argv = order.format(scene, "--out ant").split()
    assert main(["data", *argv, "--dry-run"]) == 0
    count = preset_of(scene).data.trajectories
    assert count != PRESETS["ant"].data.trajectories
    assert f"draw {count} trajectories" in capsys.readouterr().out


def test_settings_that_do_not_fit_are_refused_before_data_are_drawn(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for line, said in {
        "cartpole --network nope": "nope",
        "cartpole --sequence-length 400": "at least 400 steps, got 100: draw them",
        "cartpole --symmetries 4": "expected symmetries 1 or 2, ",
        "double_pendulum --use-symmetry": "actuators on them and one ground",
    }.items():
        assert said in refusal(capsys, "train", *line.split())
    assert not (tmp_path / "datasets").exists()


def test_training_finishes_the_data_that_it_began(tmp_path, monkeypatch):
    """Data that were cut short, by the command that drew them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(generate_module, "CHUNK", 8)
    preset = preset_of("cartpole")
    small = replace(preset, data=DataConfig(trajectories=24, steps=20))
    monkeypatch.setitem(PRESETS, "cartpole", small)
    once, calls = generate_module.simulate, iter(range(9))

    def dying(*given):
        if next(calls) == 2:
            raise KeyboardInterrupt
        return once(*given)

    monkeypatch.setattr(generate_module, "simulate", dying)
    argv = "train cartpole --network mlp-1x16 --steps 2 --rollout-steps 0 --quiet"
    argv = [*argv.split(), "--logger", "csv", "--sequence-length", "2"]
    assert main(argv) == 130
    card = json.loads((tmp_path / "datasets" / "cartpole" / "data.json").read_text())
    assert 0 < card["trajectories"] < 24
    assert main(argv) == 0
