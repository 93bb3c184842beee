"""What a model has seen in training: bounds on its outputs, and trust in its inputs.

A network says something of any input, far from its training data too. Here inputs are
taken back to the box that the data filled, changes of the state stay within the largest
ones seen, speeds within twice the largest, motions within what those lead to, and joints
stop where the data end beyond their limits: nothing inside the box is touched, and
whatever is outside stays finite and bounded. A simulator within a model knows harder
impacts than any seen: its changes stay within what the bound on speeds leaves. What is as
good as still stays where it is. How far an input lies outside is a number that can be
looked at, see `Coverage.distance`.
"""

import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.scenes.scene import Scene

MARGIN = 0.1  # of a range's width, on either side
SPEED_MARGIN = 2.0  # times the largest speed in the data
UNLIMITED = 1e300  # m/s and rad/s: finite, so that a share of it is a number
LOST = 1e6  # m and rad: no joint that overshot, but a state gone wrong
RIDGE = 1e-3  # variance added to every normalised feature before the inverse
QUANTILE = 0.99  # of training inputs that are called familiar
LARGEST_SAMPLE = 200_000  # tokens for covariance and quantile


class Coverage(nn.Module):
    """Box and spread of the training data; bounds nothing until `fit` has seen some.

    Args:
        scene: the robot.
        num_inputs: width of normalised tokens.
        num_outputs: width of normalised targets.
    """

    token_low: Tensor
    token_high: Tensor
    target_low: Tensor
    target_high: Tensor
    speed: Tensor
    qpos_low: Tensor
    is_limited: Tensor
    qpos_high: Tensor
    still: Tensor
    gain: Tensor
    center: Tensor
    whitening: Tensor
    reach: Tensor

    def __init__(self, scene: Scene, num_inputs: int, num_outputs: int) -> None:
        super().__init__()
        self.vectors, self.can_rest = _vectors(scene), scene.terrain is not None
        self.limited = _limited(scene)
        self.joint_of = [0] * scene.model.nv  # qpos of each dof's joint, if limited
        is_limited = torch.zeros(scene.model.nv, dtype=torch.float64)
        for q, v in self.limited:
            self.joint_of[v], is_limited[v] = q, 1.0
        self.register_buffer("is_limited", is_limited, persistent=False)
        one = torch.ones((), dtype=torch.float64)
        for name, size in (("token", num_inputs), ("target", num_outputs)):
            self.register_buffer(f"{name}_low", one.new_full((size,), -UNLIMITED))
            self.register_buffer(f"{name}_high", one.new_full((size,), UNLIMITED))
        self.register_buffer("speed", one.new_full((scene.model.nv,), UNLIMITED))
        self.register_buffer("qpos_low", one.new_full((scene.model.nq,), -UNLIMITED))
        self.register_buffer("qpos_high", one.new_full((scene.model.nq,), UNLIMITED))
        self.register_buffer("still", one.new_zeros(scene.model.nv))
        self.register_buffer("gain", one.new_full((scene.model.nv,), UNLIMITED))
        self.register_buffer("center", one.new_zeros(num_inputs))
        self.register_buffer("whitening", one.new_zeros(num_inputs, num_inputs))
        self.register_buffer("reach", one)

    @property
    def is_fitted(self) -> bool:
        """Whether the model knows what it was trained on."""
        return bool((self.token_high < UNLIMITED).all())

    @torch.no_grad()
    def fit(self, tokens: Tensor, targets: Tensor, qpos: Tensor, qvel: Tensor) -> None:
        """Take in a data set, in place of any before.

        Args:
            tokens: normalised, ``(samples, F)``.
            targets: normalised, ``(samples, D)``.
            qpos: ``(samples, nq)``.
            qvel: ``(samples, nv)``.
        """
        for q, _ in self.limited:
            low, high = qpos[:, q].amin(), qpos[:, q].amax()
            margin = MARGIN * (high - low)
            self.qpos_low[q], self.qpos_high[q] = low - margin, high + margin
        for name, x in (("token", tokens), ("target", targets)):
            low, high = x.amin(0), x.amax(0)
            margin = MARGIN * (high - low)
            getattr(self, f"{name}_low").copy_(low - margin)
            getattr(self, f"{name}_high").copy_(high + margin)
        self.speed.copy_(SPEED_MARGIN * self.sizes(qvel).amax(0))
        some = tokens[:: max(1, len(tokens) // LARGEST_SAMPLE)].double()
        center = some.mean(0)
        spread = (some - center).T @ (some - center) / len(some)
        ridge = RIDGE * torch.eye(len(center), dtype=some.dtype, device=some.device)
        values, axes = torch.linalg.eigh(spread + ridge)
        self.center.copy_(center)
        # the ridge bounds them from below, but for rounding beside a huge one
        self.whitening.copy_((axes / values.clamp_min(RIDGE).sqrt()).T)
        length = self.mahalanobis(some.to(tokens.dtype))
        self.reach.copy_(torch.quantile(length, QUANTILE))

    @torch.no_grad()
    def widen(self, other: "Coverage") -> None:
        """Take the bounds of another one's data in; trust and rest stay one's own.

        Those are quantiles of data that are not at hand. Nothing is changed where the
        other one has seen none.
        """
        if not other.is_fitted:
            return
        for name in ("token", "target", "qpos"):
            for end, wider in (("low", torch.minimum), ("high", torch.maximum)):
                mine = self.get_buffer(f"{name}_{end}")
                theirs = other.get_buffer(f"{name}_{end}").to(mine.device)
                mine.copy_(wider(mine, theirs))
        self.speed.copy_(torch.maximum(self.speed, other.speed.to(self.speed.device)))

    def clamp_token(self, token: Tensor) -> Tensor:
        """Normalised tokens ``(*batch, F)``, each entry within the box; NaN stays."""
        return token.clamp(self.token_low, self.token_high)

    def clamp_target(self, target: Tensor) -> Tensor:
        """Normalised changes of the state ``(*batch, D)`` within the box."""
        return target.clamp(self.target_low, self.target_high)

    def clamp_change(self, change: Tensor, step: float) -> Tensor:
        """Changes ``(*batch, 2 nv)`` no larger than from the largest speed to its opposite.

        Args:
            change: of velocities, then of positions beside the trapezoid, see `StateDelta`.
            step: s, in which they happen.
        """
        largest = torch.cat((2.0 * self.speed, step * self.speed))
        return change.clamp(-largest, largest)

    def limit_motion(self, motion: Tensor, time: float = 1.0) -> Tensor:
        """Motions ``(*batch, nv)``, no farther than the largest speed leads.

        Args:
            motion: velocities, or tangents of positions.
            time: s, that it takes.
        """
        farthest = time * self.speed
        return motion * (farthest / torch.maximum(self.sizes(motion), farthest))

    def stop_joints(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """The state with limited joints no farther than any went, and none going on.

        Args:
            qpos: ``(*batch, nq)``.
            qvel: ``(*batch, nv)``.
        """
        if not self.limited:
            return qpos, qvel
        within = qpos.clamp(self.qpos_low, self.qpos_high)
        within = torch.where(qpos.abs() < LOST, within, qpos)  # a fault stays one
        push = (within - qpos)[..., self.joint_of] * self.is_limited
        slow = torch.where(push > 0.0, qvel.clamp_min(0.0), qvel)
        return within, torch.where(push < 0.0, slow.clamp_max(0.0), slow)

    def stay(
        self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """The state after, or the one before at rest, where both are as good as still.

        Still is what is slower than the model moves a robot that rests: that motion is
        its noise, which would carry a robot away in time. What gains more speed in the
        step than a robot at rest does is not still, however slow: it begins to move, as
        on a slope that friction does not hold. Both found by `training.rest`; zero, and so
        nothing stays, for a model that has seen no rest.

        Args:
            before: ``qpos (*batch, nq)`` and ``qvel (*batch, nv)``.
            after: the same.
        """
        if not self.can_rest:
            return after
        old, new = self.sizes(before[1]), self.sizes(after[1])
        is_slow = torch.maximum(old, new) < self.still
        is_still = (is_slow & (new - old < self.gain)).all(-1, keepdim=True)
        qpos = torch.where(is_still, before[0], after[0])
        return qpos, after[1].masked_fill(is_still, 0.0)

    def mahalanobis(self, token: Tensor) -> Tensor:
        """Distance ``(*batch,)`` from the mean token in units of the data's spread."""
        return torch.linalg.vector_norm(
            (token - self.center) @ self.whitening.T, dim=-1
        )

    def excess(self, token: Tensor) -> Tensor:
        """How far outside the box the farthest entry lies, in widths ``(*batch,)``."""
        low, high = self.token_low, self.token_high
        outside = torch.maximum(low - token, token - high).clamp(min=0.0)
        return (outside / (high - low).clamp(min=RIDGE)).amax(-1)

    def distance(self, token: Tensor) -> Tensor:
        """How unfamiliar a token is ``(*batch,)``: up to 1 for 99% of training's.

        Always above 1 outside the box. Chosen among the two parts and this sum of them:
        it best predicts large one-step errors, see docs/stability.md.
        """
        spread, excess = self.mahalanobis(token) / self.reach, self.excess(token)
        return torch.where(excess > 0.0, 1.0 + spread + excess.sqrt(), spread)

    def sizes(self, qvel: Tensor) -> Tensor:
        """Magnitudes ``(*batch, nv)``, of whole vectors for free and ball joints."""
        sizes = qvel.abs()
        for start in self.vectors:
            norm = torch.linalg.vector_norm(qvel[..., start : start + 3], dim=-1)
            sizes[..., start : start + 3] = norm[..., None]
        return sizes


def _vectors(scene: Scene) -> tuple[int, ...]:
    """Where in ``qvel`` the three numbers of a vector begin."""
    linear = [scene.base.dof_address] if scene.base.is_floating else []
    return (*linear, *(v for _, v in scene.layout.rotations))


def _limited(scene: Scene) -> tuple[tuple[int, int], ...]:
    """Addresses in ``qpos`` and ``qvel`` of every hinge and slide with limits."""
    model = scene.model
    return tuple(
        (int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]))
        for joint in range(model.njnt)
        if model.jnt_limited[joint] and int(model.jnt_type[joint]) in (HINGE, SLIDE)
    )
