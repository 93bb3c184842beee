"""A survey counts what was put into the data, and its page needs nothing else."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from dynamics_helpers import little_data

from torchrl_nerd.evaluation.data_report.page import histogram, page
from torchrl_nerd.evaluation.data_report.survey import survey
from torchrl_nerd.robots import load_scene


def test_every_column_is_described(scene):
    data = little_data(scene)
    found = survey(scene, data)
    model = scene.model
    assert len(found.columns) == model.nq + model.nv + len(scene.actuated)
    assert (found.trajectories, found.steps) == tuple(data.batch_size)
    assert found.not_finite == 0
    states = data.numel()
    for number, column in enumerate(found.columns[: model.nq]):
        assert list(column.quantiles) == sorted(column.quantiles)
        assert column.counts.sum() <= states
        if column.limits is None:
            values = data["qpos"][..., number]
            assert column.quantiles[0] == values.min()
            assert column.counts.sum() == states


def test_contact_share_is_that_of_the_gaps(scene, generator):
    data = little_data(scene)
    found = survey(scene, data)
    if scene.terrain is None:
        assert found.contact_share is None and not found.point_shares
        return
    gaps = scene.clearances(data["qpos"], data.get("terrain", None))
    expected = (gaps.amin(-1) <= 0.0).double().mean()
    assert found.contact_share == pytest.approx(float(expected))
    assert found.near_share >= found.contact_share
    assert len(found.point_shares) == len(scene.contacts)
    assert max(found.point_shares.values()) <= found.contact_share


def test_what_is_odd_is_found(generator):
    scene = load_scene("cartpole")
    data = little_data(scene).clone()
    row, step = (int(torch.randint(n, (), generator=generator)) for n in data.shape)
    data["qvel"][row, step, 1] = 1e4
    data["qpos"][0, 0, 0] = torch.nan
    found = survey(scene, data)
    assert found.not_finite == 1
    worst = [x for x in found.outliers if np.isfinite(x.sigmas)][0]
    assert (worst.trajectory, worst.step, worst.value) == (row, step, 1e4)
    assert worst.name == "hinge speed (rad/s)"


def test_coverage_is_the_share_of_the_limits_that_is_reached(generator):
    scene = load_scene("cartpole")
    data = little_data(scene).clone()
    low, high = scene.model.joint("slider").range
    share = torch.rand(data.shape, generator=generator, dtype=torch.float64)
    data["qpos"][..., 0] = low + 0.5 * (high - low) * share  # one half of the rail
    column = survey(scene, data).columns[0]
    assert 0.4 < column.coverage <= 0.525
    assert column.counts[21:].sum() == 0


def test_the_page_stands_alone(scene):
    card = {"scene": "<robot>", "config": {"seed": 3}, "dropped": 7}
    text = page(survey(scene, little_data(scene)), card)
    assert "&lt;robot&gt;" in text and "<robot>" not in text
    assert not re.search(r"(src|href)=|http|<script", text)
    for name in ("Positions", "Velocities", "Outliers"):
        assert f"<h2>{name}</h2>" in text
    assert ("<h2>Contact</h2>" in text) == (scene.terrain is not None)
    body = text[text.index("<body>") :].removesuffix("</html>\n")
    ElementTree.fromstring(body)  # every tag is closed


def test_bars_are_as_high_as_their_counts(rng):
    counts = rng.integers(1, 100, 12)
    svg = ElementTree.fromstring(histogram(counts, np.linspace(0.0, 1.0, 13)))
    heights = [float(bar.get("height")) for bar in svg.iter("rect")]
    assert np.allclose(heights, 44 * counts / counts.max(), atol=0.06)
