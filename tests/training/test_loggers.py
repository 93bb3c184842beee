"""Results of a run in TensorBoard and Weights & Biases themselves, offline."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from torchrl_nerd.cli import main
from torchrl_nerd.training.log import PROJECT, TrainingLog, open_logger

BLOCK = 32 * 1024  # of the files that Weights & Biases writes: LevelDB's log format


@pytest.fixture
def run(tmp_path) -> Path:
    """The folder of a run."""
    folder = tmp_path / "some run"
    folder.mkdir()
    return folder


@pytest.fixture
def wandb(monkeypatch) -> Iterator[ModuleType]:
    """The library, which reads the environment once, as if it were new."""
    library = pytest.importorskip("wandb")

    monkeypatch.setenv("WANDB_SILENT", "true")
    library.teardown()
    yield library
    library.teardown()


@pytest.fixture
def results(rng) -> dict[int, dict[str, float]]:
    """By step, two of them."""
    return {
        step: {"loss": rng.normal(), "hinge_100": rng.normal()} for step in (10, 20, 35)
    }


def write(run: Path, name, settings, results) -> None:
    log = TrainingLog(run, 0, open_logger(name, run, 0, settings))
    for step, row in results.items():
        log.write({"step": step, **row})
    log.close()


def wandb_records(path: Path) -> Iterator:
    """What an offline run holds."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, place, parts = path.read_bytes(), 7, b""
    while place + 7 <= len(data):
        if BLOCK - place % BLOCK < 7:  # too little for a header: filled up
            place += BLOCK - place % BLOCK
        size, kind = (
            int.from_bytes(data[place + 4 : place + 6], "little"),
            data[place + 6],
        )
        parts += data[place + 7 : place + 7 + size]
        place += 7 + size
        if kind in (1, 4):  # whole, or the last part
            record = Record()
            record.ParseFromString(parts)
            yield record
            parts = b""


def finished_records(path: Path, seconds: float = 30.0) -> list:
    """All records, once the service, a process of its own, has written the last one."""
    until = time.monotonic() + seconds
    while True:
        records = list(wandb_records(path))
        if any(record.WhichOneof("record_type") == "exit" for record in records):
            return records
        assert time.monotonic() < until, f"{path} is not finished after {seconds} s"
        time.sleep(0.1)


def test_weights_and_biases_has_every_figure(wandb, run, results, monkeypatch, seed):
    monkeypatch.setenv("WANDB_MODE", "offline")
    write(run, "wandb", {"scene": "cartpole", "seed": seed}, results)
    (path,) = run.glob("wandb/offline-run-*/run-*.wandb")
    found, settings, names = {}, {}, set()
    for record in finished_records(path):
        if record.WhichOneof("record_type") == "history":
            row = {
                item.key or item.nested_key[0]: json.loads(item.value_json)
                for item in record.history.item
            }
            found[row["step"]] = {key: row[key] for key in ("loss", "hinge_100")}
        for update in (*record.run.config.update, *record.config.update):
            settings[update.key] = update.value_json
        names |= {(record.run.project, record.run.display_name)}
    assert found == results
    assert json.loads(settings["seed"]) == seed
    assert (PROJECT, "some run") in names


def test_who_has_no_key_is_told_so(wandb, run, tmp_path, monkeypatch):
    for name in ("WANDB_API_KEY", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(RuntimeError, match="No API key.*WANDB_MODE=offline"):
        open_logger("wandb", run, 0, {})


def test_tensorboard_forgets_what_a_killed_run_wrote_later(run, results):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(run, "tensorboard", {}, results)
    time.sleep(1.0)  # within a second TensorBoard tells its files' order by their names
    log = TrainingLog(run, 10, open_logger("tensorboard", run, 10, {}))
    log.write({"step": 20, "loss": 7.0})
    log.close()
    board = EventAccumulator(str(run / "tensorboard")).Reload()
    rows = [(event.step, event.value) for event in board.Scalars("loss")]
    assert rows == [(10, pytest.approx(results[10]["loss"])), (20, 7.0)]


def test_where_a_library_is_missing_the_extra_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    sizes = ["--trajectories", "4", "--steps", "20", "--out", "d", "--quiet"]
    assert main(["data", "cartpole", *sizes]) == 0
    monkeypatch.setattr("torchrl_nerd.training.log.find_spec", lambda name: None)
    argv = ["train", "cartpole", "--data", "d", "--out", "run", "--quiet"]
    assert main([*argv, "--logger", "wandb"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("nerd: --logger wandb needs the package wandb")
    assert said.endswith("in the clone, pip install -e '.[wandb]'\n")
    assert said.count("\n") == 1
    assert not (tmp_path / "run").exists()


def test_the_table_alone(run, results):
    write(run, "csv", {}, results)
    assert [path.name for path in run.iterdir()] == ["log.csv"]
    assert open_logger("csv", run, 0, {}) is None
