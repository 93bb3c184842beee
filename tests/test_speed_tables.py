"""Tables of speed: rates at equal error."""

import json
import shutil
from dataclasses import asdict, replace

import draw_races
import equal_error
import pytest
import torch
from stability_table import FIGURES

from torchrl_nerd.evaluation.bench.rates import Rate
from torchrl_nerd.evaluation.bench.report import BenchReport


def race(
    learned: tuple[float, float], *true: tuple[float | None, float]
) -> BenchReport:
    """Of one model and MuJoCo's rows, as JSON tells it: error and rate of each."""
    names = ["cube, compiled", *(f"MuJoCo x{n}" for n in range(len(true)))]
    pairs = dict(zip(names, (learned, *true), strict=True))
    speeds = {k: Rate(s, 0.5 * s, 0.0, None) for k, (_, s) in pairs.items()}
    report = BenchReport("cube", 1, 1, {}, {}, {8: speeds}, {}, {}, {}, {})
    others = {"interval": 0.0, "final": 0.0, "p95": 0.0}
    errors = {
        k: {"position": {"unit": "m", "mean": e, **others}}
        for k, (e, _) in pairs.items()
    }
    return BenchReport.from_figures(asdict(report) | {"errors": errors})


def test_mujoco_s_rate_at_an_error_is_on_its_front(generator):
    """Rates that are a power of the error stay so between rows; worse rows do not count."""
    power, scale, at = (1.0 + torch.rand(3, generator=generator)).tolist()
    true = [(error, scale * error**power) for error in (1.0, 2.0, 4.0)]
    dominated = (3.0, 0.5 * scale)
    (found,) = equal_error.ratios(race((at, 7.0), *true, dominated))
    assert (found.scene, found.model, found.batch) == ("cube", "cube", 8)
    expected = 7.0 / (scale * at**power)
    assert found.alone == pytest.approx((expected, expected))
    assert found.in_env == pytest.approx((expected, expected))


def test_beyond_mujoco_s_rows(generator):
    """Less exact than all of them counts against the fastest; more exact has no rival."""
    fastest = float(1.0 + torch.rand((), generator=generator))
    true = [(1.0, 0.5 * fastest), (2.0, fastest), (None, 9.0)]
    (found,) = equal_error.ratios(race((5.0, 3.0), *true))
    assert found.alone == pytest.approx((3.0 / fastest, 3.0 / fastest))
    (found,) = equal_error.ratios(race((0.5, 3.0), *true))
    assert "so exact" in equal_error.written(found.alone)


def test_an_arm_s_race_is_drawn_of_its_ends(tmp_path):
    path = FIGURES / "bench_franka.json"
    report = BenchReport.from_figures(json.loads(path.read_text()))
    assert draw_races.with_ends(report).quantities == ["joint1", "joint7"]
    shutil.copy(path, tmp_path)
    (tmp_path / "bench_other.json").write_text(
        json.dumps(replace(report, rates={8: report.rates[512]}).figures())
    )
    drawn = draw_races.main(draw_races.Options(tmp_path))  # the other has no such batch
    assert drawn == [tmp_path / "bench_franka.png"]
    assert drawn[0].read_bytes().startswith(b"\x89PNG")
