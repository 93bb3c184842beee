"""The report of a scene, and its text."""

import pytest
from helpers import every_scene

from torchrl_nerd.evaluation.explain.report import explain
from torchrl_nerd.evaluation.explain.table import report_table
from torchrl_nerd.modules.scene_tokens import SceneTokens

ROWS = 300


@every_scene
def test_the_report_adds_up_and_the_table_tells_all(scene, seed):
    report = explain(scene, ROWS, seed, network=None)
    assert report.size == SceneTokens(scene).size == sum(k.width for k in report.kinds)
    assert report.paper_size == sum(piece.width for piece in report.pieces)
    assert not report.unused
    assert [k.name for k in report.kinds] == [d.kind for d in report.dependences]
    text = report_table(report)
    names = [entry.name for entry in (*report.kinds, *report.pieces)]
    names += [entry.what for entry in report.dropped]
    assert all(name in text for name in names)
    assert "unused kind: none" in text and "compact over full" not in text


def test_timing_is_of_both_inputs_in_one_run(scene, seed):
    report = explain(scene, 32, seed, network="mlp-4x64")
    time = report.timing
    assert time is not None and time.network == "mlp"
    parts = (time.encode, time.step, time.paper_encode, time.paper_step, time.ratio)
    assert min(parts) > 0.0
    assert f"compact over full: {time.ratio:.2f}" in report_table(report)


def test_few_rows_and_unknown_networks_are_refused(scene):
    with pytest.raises(ValueError, match="rows of at least 16, got 3"):
        explain(scene, 3)
    with pytest.raises(ValueError, match="unknown network 'huge'"):
        explain(scene, 32, network="huge")
