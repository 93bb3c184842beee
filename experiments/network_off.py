"""Every shipped hybrid with its network and without it, passive and driven.

    python experiments/network_off.py --json results/network_off.json

A hybrid is shipped only where its network lowers the error of its own analytic step
outside the interval, in passive and in driven test rollouts. "Without" sets the last layer
of the network to zero; nothing else changes. Driven means uniform random actions.
"""

import copy
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import torch
import tyro
from torch import nn

from torchrl_nerd import from_pretrained
from torchrl_nerd.checkpoint import shipped_card, shipped_models
from torchrl_nerd.dynamics import MujocoDynamics, NeRDDynamics
from torchrl_nerd.evaluation.rollout_error import passive_errors, scene_of
from torchrl_nerd.modules.nerd import NeRD
from torchrl_nerd.robots import protocol_of


@dataclass
class Options:
    """What to measure."""

    num_trajectories: int = 256
    """Per case of the scene's protocol."""
    seed: int = 7777
    """Of the initial states; no training or validation uses it."""
    json: Path | None = None
    """Write the results to this file."""


def without_network(model: NeRD) -> NeRD:
    """A copy whose network's last layer is zero: of a hybrid its analytic step alone."""
    copied = copy.deepcopy(model)
    last = [m for m in copied.network.head.modules() if isinstance(m, nn.Linear)][-1]
    for weight in last.parameters():
        nn.init.zeros_(weight)
    return copied


def measure(name: str, num_trajectories: int, seed: int) -> list[dict[str, Any]]:
    """Error with and without the network, a row per case, drive and quantity."""
    model = cast(NeRD, from_pretrained(name))
    protocol, rows = protocol_of(model.scene), []
    steps = max(protocol.horizons)
    for case, source in protocol.cases.items():
        scene = scene_of(source)
        for drive in ("passive", "driven"):
            found = []
            for each in (model, without_network(model)):
                here = each if scene is each.scene else each.with_terrain(scene)
                errors = passive_errors(
                    source,
                    NeRDDynamics(here),
                    MujocoDynamics(scene),
                    [steps],
                    num_trajectories,
                    seed,
                    random_actions=drive == "driven",
                )
                found.append(errors[steps])
            for quantity, shown in found[0].items():
                row = {"model": name, "case": case, "drive": drive, "steps": steps}
                row |= {"quantity": quantity, "with": asdict(shown)}
                rows.append(row | {"without": asdict(found[1][quantity])})
    return rows


def main(options: Options) -> None:
    """Print a table and write the results."""
    hybrids = [n for n in shipped_models() if shipped_card(n)["kind"] == "hybrid"]
    rows = []
    for name in hybrids:
        rows += measure(name, options.num_trajectories, options.seed)
    print(f"{'model':<30} {'case':<9} {'drive':<8} {'quantity':<9}  with  without")
    for row in rows:
        a, b = row["with"], row["without"]
        head = f"{row['model']:<30} {row['case']:<9} {row['drive']:<8}"
        print(
            f"{head} {row['quantity']:<9} {a['mean']:.5f} ± {a['interval']:.5f}  "
            f"{b['mean']:.5f} ± {b['interval']:.5f} {a['unit']}"
        )
    if options.json is not None:
        from torchrl_nerd.evaluation.results import write_results

        write_results(options.json, rows, options.seed)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Options))
