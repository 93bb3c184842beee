"""Mean errors of all cases in one table; models that are worse than cheap rivals."""

import math

import pytest

from torchrl_nerd.evaluation.bench.errors import ErrorRow
from torchrl_nerd.evaluation.bench.summary import summary, summary_table, warnings
from torchrl_nerd.robots import load_scene

COARSE = "MuJoCo Euler, 1 substep"
KINDS = {
    "no motion": "baseline",
    COARSE: "simulator",
    "MuJoCo RK4, 1 substep": "simulator",
}
KINDS |= {"good": "learned", "bad": "learned"}


def rows_of(name, errors, cases=("passive", "driven"), steps=(20, 100)):
    """Rows of every case and horizon; ``errors`` by quantity, m or rad."""
    return [
        ErrorRow(case, length, name, KINDS[name], quantity, unit, mean)
        for case in cases
        for length in steps
        for (quantity, unit), mean in errors.items()
    ]


def arm(value):
    """Errors of Franka's seven joints, about a mean."""
    return {(f"joint{i}", "rad"): value * i / 4.0 for i in range(1, 8)}


def test_an_arm_is_one_table_of_the_means_over_its_joints():
    scene = load_scene("franka")
    rows = rows_of("no motion", arm(1.0)) + rows_of("good", arm(0.25))
    for by_column in summary(scene, rows).values():
        assert list(by_column) == [
            (case, steps, "joints", "rad")
            for case in ("passive", "driven")
            for steps in (20, 100)
        ]
    case, steps, quantity, unit, *lines = summary_table(scene, rows).splitlines()
    assert case.split() == ["case", *["passive"] * 2, *["driven"] * 2]
    assert steps.split() == ["steps", *["20", "100"] * 2]
    assert quantity.split() == ["mean", "error", *["joints"] * 4]
    assert unit.split() == ["name", "kind", *["rad"] * 4]
    assert [line.split() for line in lines] == [
        ["no", "motion", "baseline", *["1"] * 4],
        ["good", "learned", *["0.25"] * 4],
    ]


def test_joints_of_different_units_keep_their_names_and_cases_stay_together():
    scene = load_scene("cartpole")
    errors = {("slider", "m"): 0.5, ("hinge", "rad"): 2.0}
    rows = rows_of("no motion", errors, steps=(20, 100, 500))
    first, second = summary_table(scene, rows).split("\n\n")
    for part, case in ((first, "passive"), (second, "driven")):
        lines = part.splitlines()
        assert lines[0].split() == ["case", *[case] * 6]
        assert lines[2].split() == ["mean", "error", *["slider", "hinge"] * 3]


def test_a_model_that_is_worse_than_cheap_rivals_is_named_once():
    scene = load_scene("franka")
    rows = rows_of("no motion", arm(1.0)) + rows_of(COARSE, arm(0.1))
    rows += rows_of("MuJoCo RK4, 1 substep", arm(0.001)) + rows_of("good", arm(0.05))
    assert warnings(scene, rows) == []
    bad = rows_of("bad", arm(0.5), ["passive"]) + rows_of("bad", arm(2.0), ["driven"])
    assert warnings(scene, rows + bad) == [
        "bad has a larger mean error than no motion in driven (20 steps), driven (100 "
        f"steps), and than {COARSE} in every case."
    ]


def test_one_substep_that_is_the_ground_truth_is_no_rival(monkeypatch):
    scene = load_scene("franka")
    rows = rows_of("no motion", arm(1.0)) + rows_of("MuJoCo RK4, 1 substep", arm(0.1))
    monkeypatch.setitem(KINDS, COARSE, "ground truth")
    assert (
        warnings(scene, rows_of(COARSE, arm(0.0)) + rows + rows_of("bad", arm(0.5)))
        == []
    )


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_diverges_is_worse_and_worse_than_nothing_else(value):
    scene = load_scene("franka")
    rows = rows_of("no motion", arm(1.0)) + rows_of(COARSE, arm(value))
    rows += rows_of("good", arm(0.5)) + rows_of("bad", arm(value))
    assert warnings(scene, rows) == [
        "bad has a larger mean error than no motion in every case."
    ]
    assert "diverges" in summary_table(scene, rows)
