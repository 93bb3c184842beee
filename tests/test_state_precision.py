"""The benchmark of states in float32, at a tiny budget."""

import json

import state_dtype


def test_a_row_for_every_model(seed, tmp_path):
    path = tmp_path / "state_dtype.json"
    options = state_dtype.Options(("cube-mlp",), 2, 2, 1, seed, path)
    state_dtype.main(options)
    (row,) = json.loads(path.read_text())["results"].values()
    assert row["case"] == "toss" and row["steps"] == 80
    for quantity, error in row["float64"].items():
        assert 0.0 < row["float32"][quantity] < 2.0 * error + 1e-3
    assert row["float64_us"] > 0.0 and row["float32_us"] > 0.0
