"""Contact points by the package's own kinematics and by pytorch-kinematics.

    python benchmarks/kinematics_libraries.py --json results/kinematics_libraries.json

Milliseconds for the points of many robots, positions alone and with velocities. Franka has
no contact points: a point on each of its links stands for them. pytorch-kinematics has
Jacobians of serial chains alone. So its velocities are of the faster of two ways: the
derivative of its forward kinematics along ``qvel`` (forward mode), or a Jacobian per body.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from pytorch_kinematics import Chain, SerialChain
from torch import Tensor
from torch.autograd import forward_ad
from tyro.conf import Positional

from torchrl_nerd.evaluation.results import write_results
from torchrl_nerd.evaluation.tables import text_table
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.serial_chain import add_body, make_frame
from torchrl_nerd.robots import load_scene
from torchrl_nerd.scenes import Scene

Points = tuple[Tensor, Tensor]  # positions and velocities in B_t, (N, P, 3) each
Function = Callable[[Tensor, Tensor], Any]
FLOAT64: dict[str, Any] = {"dtype": torch.float64}


@dataclass
class Options:
    """What to time."""

    scenes: Positional[tuple[str, ...]] = ("ant", "franka")
    num_envs: int = 512
    """Robots stepped together."""
    rounds: int = 40
    """Samples of each time; the fastest is shown, which other work disturbs least."""
    compile: bool = True
    """Time compiled code too, which takes minutes to make."""
    seed: int = 0
    json: Path | None = None
    """Write the results to this file."""


class Library:
    """The same points by pytorch-kinematics: one chain of all bodies, one per body."""

    def __init__(self, scene: Scene, bodies: list[int], places: np.ndarray) -> None:
        model, base = scene.model, scene.base
        root = make_frame("base", np.eye(4))
        at = {base.body: (root, np.eye(4))}
        for body in range(base.body + (base.is_floating), model.nbody):
            parent, offset = at.get(int(model.body_parentid[body]), (root, np.eye(4)))
            if body == base.body:  # B_t is a fixed base's frame before its joints move
                place, quat = model.body_pos[body].copy(), model.body_quat[body].copy()
                model.body_pos[body], model.body_quat[body] = 0.0, (1.0, 0.0, 0.0, 0.0)
                at[body] = add_body(model, body, parent, offset)
                model.body_pos[body], model.body_quat[body] = place, quat
            else:
                at[body] = add_body(model, body, parent, offset)
        for body in dict.fromkeys(bodies):
            frame, offset = at[body]
            frame.children = [*frame.children, make_frame(f"body {body}", offset)]
        self.tree = Chain(root, **FLOAT64)
        joints = [
            int(name.split()[1]) for name in self.tree.get_joint_parameter_names()
        ]
        self.qpos_at = model.jnt_qposadr[joints].tolist()
        self.dof_at = model.jnt_dofadr[joints].tolist()
        self.frames = [self.tree.frame_to_idx[f"body {body}"] for body in bodies]
        self.places = torch.from_numpy(places.copy())[:, None]  # (P, 1, 3)
        self.chains = []
        for body in dict.fromkeys(bodies):
            own = [index for index, other in enumerate(bodies) if other == body]
            if body == base.body and base.is_floating:
                self.chains.append((None, [], own))
                continue
            chain = SerialChain(Chain(root, **FLOAT64), f"body {body}", **FLOAT64)
            names = chain.get_joint_parameter_names()
            order = [self.tree.get_joint_parameter_names().index(x) for x in names]
            self.chains.append((chain, order, own))
        self.order = [index for _, _, own in self.chains for index in own]

    def positions(self, qpos: Tensor, qvel: Tensor) -> Tensor:
        """Of all points, from one pass over the tree."""
        pose = self.tree.forward_kinematics_tensor(qpos[:, self.qpos_at])[self.frames]
        turned = (pose[..., :3, :3] @ self.places[..., None])[..., 0]
        return (pose[..., :3, 3] + turned).transpose(0, 1)

    def by_forward_mode(self, qpos: Tensor, qvel: Tensor) -> Points:
        """Positions, and their derivative along the joint rates."""
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(qpos[:, self.qpos_at], qvel[:, self.dof_at])
            pose = self.tree.forward_kinematics_tensor(dual)[self.frames]
            turned = (pose[..., :3, :3] @ self.places[..., None])[..., 0]
            points = (pose[..., :3, 3] + turned).transpose(0, 1)
            position, velocity = forward_ad.unpack_dual(points)
        return position, velocity  # pyright: ignore

    def by_jacobians(self, qpos: Tensor, qvel: Tensor) -> Points:
        """Positions and velocities from the Jacobian of each body."""
        q, v, found = qpos[:, self.qpos_at], qvel[:, self.dof_at], []
        for chain, order, own in self.chains:
            places = self.places[own, 0]  # (p, 3)
            if chain is None:
                still = places.expand(len(qpos), *places.shape)
                found.append((still, torch.zeros_like(still)))
                continue
            jacobian, pose = chain.jacobian_tensor(q[:, order], ret_eef_pose=True)
            rate = (jacobian @ v[:, order, None])[..., 0]  # (N, 6)
            arm = places @ pose[:, :3, :3].mT  # (N, p, 3)
            spin = rate[:, None, 3:].expand_as(arm)
            velocity = rate[:, None, :3] + torch.linalg.cross(spin, arm)
            found.append((pose[:, None, :3, 3] + arm, velocity))
        parts = (torch.cat(x, 1) for x in zip(*found, strict=True))
        back = np.argsort(self.order).tolist()
        position, velocity = (x[:, back] for x in parts)
        return position, velocity


def points_of(scene: Scene) -> tuple[list[int], np.ndarray]:
    """Contact points, or a point on each moving body where nothing can touch."""
    contacts, model = scene.contacts, scene.model
    if len(contacts):
        return contacts.bodies, contacts.positions
    bodies = [b for b in range(1, model.nbody) if model.body_weldid[b] == b]
    return bodies, np.full((len(bodies), 3), 0.1)


def milliseconds(function: Function, state: Points, rounds: int) -> float:
    """Time of the fastest call."""
    times = []
    with torch.no_grad():
        for number in range(rounds + 3):
            began = time.perf_counter()
            function(*state)
            if number >= 3:  # the first calls compile and warm up
                times.append(time.perf_counter() - began)
    return 1e3 * min(times)


def measure(name: str, options: Options) -> list[dict[str, Any]]:
    """A row per library and way to run it."""
    scene = load_scene(name)
    bodies, places = points_of(scene)
    own = PointKinematics(scene.model, scene.base, bodies, places)
    library = Library(scene, bodies, places)
    generator = torch.Generator().manual_seed(options.seed)
    start, _ = scene.sample_initial(options.num_envs, generator)
    state = start["qpos"], start["qvel"]
    want = own(*state)
    for got in (library.by_forward_mode(*state), library.by_jacobians(*state)):
        for x, y in zip(got, want, strict=True):
            torch.testing.assert_close(x, y, rtol=1e-9, atol=1e-9)

    def positions(qpos: Tensor, qvel: Tensor) -> Tensor:
        return own(qpos, qvel[:0])[0]

    ways: dict[str, tuple[Function, tuple[Function, ...]]] = {
        "own": (positions, (own,)),
        "pytorch-kinematics": (
            library.positions,
            (library.by_forward_mode, library.by_jacobians),
        ),
    }
    found = []
    for is_compiled in (False, True)[: 1 + options.compile]:
        for kind, (placing, both) in ways.items():
            times = []
            for function in (placing, *both):
                # forward mode cannot be compiled: it is timed as it is
                if is_compiled and function != library.by_forward_mode:
                    function = torch.compile(function)
                times.append(milliseconds(function, state, options.rounds))
            found.append(
                {
                    "scene": name,
                    "library": kind,
                    "points": len(bodies),
                    "num_envs": options.num_envs,
                    "compiled": is_compiled,
                    "positions_ms": times[0],
                    "with_velocities_ms": min(times[1:]),
                }
            )
    return found


def main(options: Options) -> list[dict[str, Any]]:
    """Print a table and write the results."""
    rows = [row for name in options.scenes for row in measure(name, options)]
    head = ["scene", "library", "compiled", "positions (ms)", "with velocities (ms)"]
    body = [
        [
            row["scene"],
            row["library"],
            "yes" if row["compiled"] else "no",
            f"{row['positions_ms']:.2f}",
            f"{row['with_velocities_ms']:.2f}",
        ]
        for row in rows
    ]
    print(text_table(head, body))
    if options.json is not None:
        write_results(options.json, rows, options.seed)
    return rows


if __name__ == "__main__":
    main(tyro.cli(Options))
