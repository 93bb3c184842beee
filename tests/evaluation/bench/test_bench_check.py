"""The check of speed: it says what got worse, in a sentence, and nothing else."""

import pytest
from bench_check import (
    LEAST_ROUNDS,
    MUJOCO,
    Options,
    Ratio,
    Sample,
    compare,
    main,
    ratios,
    summarize,
)

from torchrl_nerd.files import read_json

SURE = {"a": Ratio(2.0, 0.0), "b": Ratio(0.5, 0.0)}


def test_equal_and_better_ratios_are_no_news():
    assert not compare(SURE, {"a": 2.0, "b": 0.5}, 0.0)
    assert not compare(SURE, {"a": 1.0, "b": 0.1}, 0.0)


def test_a_ratio_is_worse_beyond_the_tolerance_and_its_spread():
    baseline = {"a": 2.0, "b": 1.0}  # b fell by half
    (said,) = compare(SURE, baseline, 0.49)
    assert said == "b fell from 1 to 0.5 (+-0%), by more than 49%."
    assert not compare(SURE, baseline, 0.51)
    unsure = SURE | {"b": Ratio(0.5, 0.1)}
    assert compare(unsure, baseline, 0.44) and not compare(unsure, baseline, 0.46)


def test_a_ratio_on_one_side_only_is_told():
    (said,) = compare(SURE, {"a": 2.0}, 0.1)
    assert said == "b is only measured: write a new baseline."
    (said,) = compare({}, {"a": 2.0}, 0.1)
    assert said == "a is only in the baseline: write a new baseline."


def test_a_ratio_is_the_median_and_its_spread_shrinks_with_the_rounds(rng):
    assert summarize([3.0] * 5) == Ratio(3.0, 0.0)
    draw = (3.0 + 0.3 * rng.normal(size=4000)).tolist()
    few, many = summarize(draw[:40]), summarize(draw)
    assert many.value == pytest.approx(3.0, rel=0.02) and many.spread < few.spread
    assert many.spread == pytest.approx(1.57 * 1.349 * 0.1 / 4000**0.5, rel=0.2)


def test_ratios_are_of_one_round():
    samples = {
        MUJOCO: Sample(100.0, 50.0),
        "m": Sample(200.0, 150.0),
        "m, compiled": Sample(300.0, 1.0),
        "m, window": Sample(20.0, 1.0),
        "n": Sample(50.0, 10.0),
        "n, compiled": Sample(50.0, 10.0),
    }
    assert ratios(samples) == {
        "m / MuJoCo": 2.0,
        "m: env / dynamics": 0.75,
        "m: streaming / window": 10.0,
        "m: compiled / eager": 1.5,
        "n / MuJoCo": 0.5,
        "n: env / dynamics": 0.2,
        "n: compiled / eager": 1.0,
    }


@pytest.fixture
def small(tmp_path) -> Options:
    """The smallest benchmark there is."""
    return Options(
        tasks=("cartpole/swingup",),
        num_envs=2,
        rounds=LEAST_ROUNDS,
        spread=100.0,
        baseline=tmp_path / "baseline.json",
    )


def test_without_a_baseline_it_says_so_before_it_measures(small):
    with pytest.raises(ValueError, match="found no file"):
        main(small)


@pytest.mark.slow
def test_a_small_benchmark_writes_its_baseline(small):
    small.write = True
    assert main(small) == []
    written = read_json(small.baseline)
    assert "cartpole" in written["networks"] and written["ratios"]
    assert all(row["value"] > 0.0 for row in written["ratios"].values())
    small.write, small.num_envs = False, 3
    with pytest.raises(ValueError, match="has other rows: write a new baseline"):
        main(small)
    small.rounds = 1
    with pytest.raises(ValueError, match="expected rounds of at least 5, got 1"):
        main(small)


@pytest.mark.slow
def test_a_small_benchmark_agrees_with_the_baseline_it_wrote(small):
    small.write = True
    main(small)
    small.write = False
    said = main(small)  # rounding apart, a busy machine may say that something fell
    assert all("fell from" in sentence for sentence in said)
