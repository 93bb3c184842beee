"""Rates at equal error, and pictures of benchmarks, from files of results."""

import math
from dataclasses import asdict

import draw_benchmarks
import equal_error
import pytest
import torch

from torchrl_nerd.evaluation.bench.errors import ErrorRow
from torchrl_nerd.evaluation.bench.rates import RateRow
from torchrl_nerd.evaluation.bench.report import BenchReport
from torchrl_nerd.evaluation.results import write_results


def report(
    learned: tuple[float, float], *true: tuple[float, float], quantity: str = "position"
) -> BenchReport:
    """Of one model and MuJoCo's settings: error and rate of each."""
    names = [
        "cube, compiled",
        *(f"MuJoCo Euler, {n} substeps" for n in range(len(true))),
    ]
    errors, rates = [], []
    for name, (error, rate) in zip(names, (learned, *true), strict=True):
        kind = "simulator" if name.startswith("MuJoCo") else "learned"
        row = ("toss", 1, name, kind, quantity, "m", error, 0.0, 0.0, 0.0)
        errors.append(ErrorRow(*row))
        rates.append(RateRow(name, kind, 8, rate, 0.0))
    return BenchReport("cube", 1, 2, "MuJoCo Euler, 80 substeps", errors, rates)


def test_mujoco_s_rate_at_an_error_is_on_its_front(generator):
    """Rates that are a power of the error stay so between points; a worse one is none."""
    power, scale, at = (1.0 + torch.rand(3, generator=generator)).tolist()
    true = [(error, scale * error**power) for error in (1.0, 2.0, 4.0)]
    dominated = (3.0, 0.5 * scale)
    (found,) = equal_error.ratios(report((at, 7.0), *true, dominated))
    assert (found.scene, found.model, found.batch) == ("cube", "cube", 8)
    expected = 7.0 / (scale * at**power)
    assert (found.low, found.high) == pytest.approx((expected, expected))


def test_beyond_mujoco_s_points(generator):
    """Less accurate than all of them counts against the fastest; more, has no rival."""
    fastest = float(1.0 + torch.rand((), generator=generator))
    true = [(1.0, 0.5 * fastest), (2.0, fastest), (float("nan"), 9.0)]
    (found,) = equal_error.ratios(report((5.0, 3.0), *true))
    assert (found.low, found.high) == pytest.approx((3.0 / fastest, 3.0 / fastest))
    (found,) = equal_error.ratios(report((0.5, 3.0), *true))
    assert "never so accurate" in equal_error.written(found)
    (found,) = equal_error.ratios(report((math.nan, 3.0), *true))
    assert equal_error.written(found) == "diverges"


def test_files_of_results_are_read_and_drawn(tmp_path):
    made = report((0.5, 3.0), (1.0, 1.0), (float("nan"), 9.0))
    path = tmp_path / "bench_cube.json"
    write_results(path, asdict(made), 500, command="nerd bench cube")
    (read,) = equal_error.reports(tmp_path).values()
    assert repr(read) == repr(made)  # NaN, too
    assert "| cube |" in equal_error.table(equal_error.read(tmp_path))
    drawn = draw_benchmarks.main(draw_benchmarks.Options(tmp_path, tmp_path))
    assert drawn == [tmp_path / "bench_cube.svg"]
    assert "<svg" in drawn[0].read_text()
