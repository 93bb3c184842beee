"""Features of a robot's contacts with itself: distance, normal, velocity, prediction."""

import torch
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_nerd.configs import FeatureConfig
from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.kinematics import PointKinematics
from torchrl_nerd.geometry.manifold import integrate_pos
from torchrl_nerd.geometry.segments import between_segments
from torchrl_nerd.keys import QPOS, QVEL, SELF_CONTACT
from torchrl_nerd.scenes.scene import Scene
from torchrl_nerd.scenes.self_contacts import capsule_pairs
from torchrl_nerd.transforms.base import FeatureTransform
from torchrl_nerd.transforms.contact_features import FADE
from torchrl_nerd.transforms.predicted_contact import (
    depth_at_constant_velocity,
    parabola,
    times_of,
)

TOUCHING = 1e-9  # m: axes closer than this have no direction between them


class SelfContactFeatures(FeatureTransform):
    """Distance, normal, velocity and predicted depth of pairs of the robot's own shapes.

    Of the P pairs of `capsule_pairs`, all in B_t, with distance d, margin xi and a gate
    g(d) = 0 at d >= xi and 1 well inside:

    | part of ``self_contact`` | what | width |
    |---|---|---|
    | distance | min(d - xi, 0), m | P |
    | normal | g * n, from the first shape to the second | 3 P |
    | velocity | g * (normal speed, tangential velocity) of the second relative to the
      first, at the axes of their capsules, m/s | 4 P |
    | depth | g * penetration at K times of the step at constant velocity, m | K P |

    The K times are those of `times_of`. No keys at all where no shapes come
    near each other, or where the model's `FeatureConfig` does not ask for them.
    """

    why_no_inverse = "distances do not determine a pose"
    radii: Tensor
    margins: Tensor
    parabola: Tensor

    def __init__(self, scene: Scene, features: FeatureConfig) -> None:
        pairs = capsule_pairs(scene.model) if features.self_contact else None
        times, sizes = times_of(scene), {}
        if pairs:
            sizes[SELF_CONTACT] = (8 + len(times)) * len(pairs)
        super().__init__(scene, [QPOS, QVEL] if pairs else [], sizes)
        if not pairs:
            return
        self.layout, self.period = scene.layout, scene.control_step
        ends = pairs.bodies.flatten().tolist(), pairs.ends
        self.kinematics = PointKinematics(scene.model, scene.base, *ends)
        keep_constants(
            self, radii=pairs.radii, margins=pairs.margins, parabola=parabola(times)
        )

    def self_contact_features(self, qpos: Tensor, qvel: Tensor) -> list[Tensor]:
        """The output, if there is one, ``(*batch, D)`` in the dtype of the inputs.

        Of ``qpos (*batch, nq)`` and ``qvel (*batch, nv)``.
        """
        if not self.sizes:
            return []
        later = integrate_pos(self.layout, qpos, self.period * qvel)
        # both ends of the step at once, of which only the first has velocities
        points, velocities = self.kinematics(torch.stack((qpos, later)), qvel)
        between, first, second = between_segments(*points.chunk(4, -2))
        distance = torch.linalg.vector_norm(between, dim=-1)  # (2, *batch, P)
        normal = between[0] / distance[0].clamp_min(TOUCHING)[..., None]
        distance = distance - self.radii
        a, b, c, d = velocities.chunk(4, -2)
        velocity = torch.lerp(c, d, second[0]) - torch.lerp(a, b, first[0])
        beyond = distance[0] - self.margins
        gate = (-beyond / (FADE * self.margins)).clamp(0.0, 1.0)[..., None]
        speed = (velocity * normal).sum(-1, keepdim=True)
        motion = -distance[0], -self.period * speed[..., 0], -distance[1]
        depth = depth_at_constant_velocity(self.parabola, *motion)
        # (*batch, P, 7 + K)
        gated = gate * torch.cat((normal, speed, velocity - speed * normal, depth), -1)
        return [torch.cat((beyond.clamp_max(0.0), gated.flatten(-2)), -1)]

    def _features(self, tensordict: TensorDictBase) -> dict:
        values = self.self_contact_features(tensordict[QPOS], tensordict[QVEL])
        return dict(zip(self.out_keys, values, strict=True))
