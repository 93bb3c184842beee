"""What a model's hidden state says of the parameters, and how soon it follows a change."""

import statistics
import time
from typing import Any, NamedTuple, cast

import torch
from tensordict import TensorDict
from torch import Generator, Tensor

from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.dynamics import NeRDDynamics
from torchrl_nerd.keys import (
    CTRL,
    JOINT_TORQUE,
    NEXT_QVEL,
    PARAMETERS,
    QPOS,
    QVEL,
    TERRAIN,
)
from torchrl_nerd.modules.nerd import TARGET, NeRD
from torchrl_nerd.modules.networks import network_config
from torchrl_nerd.modules.transformer import Attention
from torchrl_nerd.scenes import Scene

from .motions import draw_parameters, motions

ROWS = 512
CHANGE, AFTER = 100, 60  # step at which a parameter changes, steps after it
SEEN = 50  # steps of history that a probe reads the hidden state after
LAST = 10  # steps whose hidden states a probe reads the mean of
RIDGE = 1e-3
BANDS, ENVS, TURNS = (10, 32, 64, 128), 512, 15
BACK = 2.0  # the error is back below this many times its former level
CHANGES = {  # kind of parameter -> what it is multiplied by
    "motor": 2.0 / 3.0,
    "mass": 2.0,
}


class Watched(NamedTuple):
    """A model that sees recorded motions ``[rows, T]`` step by step."""

    errors: Tensor  # (rows, T): of the next velocity
    hidden: Tensor  # (rows, T, w): hidden states
    unlike: Tensor  # (rows, T): out-of-distribution score, see `OODScore`


def watch(model: NeRD, data: TensorDict) -> Watched:
    """Errors, hidden states and scores along recorded motions.

    Errors are root mean squares over dofs, in standard deviations of one step's change, of
    a model that sees the recorded motion step by step. Hidden is what each layer's
    attention brings from the past; of a network without attention, what its head gets.
    """
    dynamics, errors, hidden, unlike = NeRDDynamics(model), [], [], []
    scale = model.normalize.std(TARGET)[: model.scene.layout.nv]
    layers = [m.output for m in model.network.modules() if isinstance(m, Attention)]
    watched, seen = layers or [model.network.head], []
    handles = [
        layer.register_forward_pre_hook(
            lambda _, given: seen.append(given[0].flatten(1).clone())
        )
        for layer in watched
    ]
    dynamics.reset(cast(TensorDict, data[:, 0]))
    for now in data.unbind(1):
        state = now.select(QPOS, QVEL, PARAMETERS)
        given = (now.get(key, None) for key in (JOINT_TORQUE, TERRAIN, CTRL))
        after = dynamics.step(state, *given, is_scored=True)
        unlike.append(after["ood_score"])
        miss = (after[QVEL] - now[NEXT_QVEL]) / scale
        errors.append(miss.square().mean(-1).sqrt())
        hidden.append(torch.cat(seen, -1))
        seen.clear()
    for handle in handles:
        handle.remove()
    return Watched(*(torch.stack(x, 1) for x in (errors, hidden, unlike)))


def changes(scene: Scene, models: dict[str, NeRD], seed: int) -> list[dict[str, Any]]:
    """Median one-step error before and after a parameter changes, a row per change.

    ``steps_until_back``: steps until the median stays below `BACK` times its level before.
    ``untrusted``: share of motions that the trust gate does not trust, 20 steps each.
    """
    variation, rows = scene.variation, []
    assert variation is not None
    for kind, factor in CHANGES.items():
        chosen = [i for i, p in enumerate(variation.parameters) if p.kind == kind]
        if not chosen:
            continue
        column = chosen[-1]
        generator = Generator().manual_seed(seed)
        before = draw_parameters(scene, "inside", ROWS, generator)
        after = before.clone()
        after[:, column] *= factor
        data = motions(scene, [before, after], [CHANGE, AFTER], generator)
        for name, model in models.items():
            seen = watch(model, data)
            median = seen.errors.median(0).values
            lost = (seen.unlike > 1.0).double().mean(0)  # whose trust is below 1
            level = float(median[CHANGE - 20 : CHANGE].mean())
            late = (median[CHANGE:] > BACK * level).nonzero()
            back = int(late.max()) + 1 if len(late) else 0
            rows.append(
                {
                    "parameter": variation.parameters[column].name,
                    "factor": factor,
                    "name": name,
                    "before": level,
                    "first": float(median[CHANGE : CHANGE + 3].max()),
                    "steps_until_back": back if back < AFTER else None,
                    "untrusted_before": float(lost[CHANGE - 20 : CHANGE].mean()),
                    "untrusted_after": float(lost[CHANGE : CHANGE + 20].mean()),
                    "median": median[CHANGE - 20 :].tolist(),
                }
            )
            print("change", kind, name, *list(rows[-1].values())[3:8], flush=True)
    return rows


def probe(scene: Scene, models: dict[str, NeRD], seed: int) -> list[dict[str, Any]]:
    """Share of each parameter's variance that is linear in the hidden state.

    Fitted on half of the motions, measured on the other half, after `SEEN` steps. Points:
    true and inferred place in the range, -1 to 1, of some test motions.
    """
    variation, rows = scene.variation, []
    assert variation is not None
    generator = Generator().manual_seed(seed)
    own = draw_parameters(scene, "inside", 4 * ROWS, generator)
    data = motions(scene, [own], [SEEN + 1], generator)
    given, half = data[PARAMETERS][:, 0], len(data) // 2
    actual, told = variation.shares(given), list(variation.ranges)
    if "motor" in told and told[0].startswith("mass"):  # what a torque's effect shows
        ratio = (given[:, told.index("motor")] / given[:, 0]).log()
        actual = torch.cat((actual, (ratio / ratio.abs().max())[:, None]), 1)
        told.append(f"motor / {told[0]}")
    for name, model in models.items():
        state = watch(model, data).hidden[:, -LAST:].mean(1).double()
        state = (state - state[:half].mean(0)) / state[:half].std(0).clamp_min(1e-9)
        state = torch.cat((state, torch.ones(len(state), 1)), 1)
        a, b = state[:half], actual[:half]
        eye = RIDGE * half * torch.eye(a.shape[1], dtype=a.dtype)
        guess = state[half:] @ torch.linalg.solve(a.T @ a + eye, a.T @ b)
        miss = (guess - actual[half:]).square().mean(0) / actual[half:].var(0)
        share = dict(zip(told, (1.0 - miss).tolist(), strict=True))
        points = torch.stack((actual[half:], guess), -1)[:200].tolist()
        rows.append({"name": name, "explained": share, "points": points})
        print("probe", name, {k: round(v, 2) for k, v in share.items()}, flush=True)
    return rows


def rates(scene: Scene, models: dict[str, NeRD]) -> list[dict[str, Any]]:
    """Control steps per second and size of the history, of ``models`` and by band.

    The bands are those of a transformer 2x64 with random weights. All take turns, so that a
    machine that others use slows all alike.
    """
    found: dict[str, list[float]] = {}
    start = scene.sample_initial(ENVS, Generator().manual_seed(0))[0]
    terrain, state = start.pop(TERRAIN, None), TensorDict(start, [ENVS])
    torque = torch.zeros(ENVS, len(scene.actuated), dtype=torch.float64)
    features = FeatureConfig()
    bands = {
        f"transformer 2x64, band {band}": NeRD(
            scene, features, network_config(f"transformer-2x64@{band}")
        )
        for band in BANDS
    }
    # a model that is told parameters steps no robot without them
    own = {k: m for k, m in models.items() if not m.scene_features.config.parameters}
    dynamics = {name: NeRDDynamics(m) for name, m in (bands | own).items()}
    for turn in range(TURNS + 1):
        for name, each in dynamics.items():
            began = time.perf_counter()
            for _ in range(10):
                each.step(state, torque, terrain)
            if turn:  # the first one warms up
                rate = 10 * ENVS / (time.perf_counter() - began)
                found.setdefault(name, []).append(rate)
    rows = []
    for name, values in found.items():
        kib = size_of(dynamics[name].history()) / ENVS / 1024
        rate = statistics.median(values)
        rows.append({"name": name, "steps_per_s": rate, "history_kib_per_env": kib})
    print("rates", {row["name"]: round(row["steps_per_s"]) for row in rows}, flush=True)
    return rows


def size_of(history: object) -> int:
    """Bytes of the tensors of a history, or of lists of them."""
    if isinstance(history, Tensor):
        return history.numel() * history.element_size()
    parts = history if isinstance(history, list) else vars(history).values()
    return sum(map(size_of, parts))
