"""What a model knows of its training data: their range, their spread, and rest in them.

A network returns something for any input, far from its training data too. So features are
clamped to the range that the data filled, changes of the state stay within the largest in
the data, speeds within twice the largest, displacements within what those speeds reach, and
limited joints stop where the data end. Nothing inside the range is changed; whatever is
outside stays finite and bounded.
"""

import numpy as np
import torch
from torch import Tensor, nn

from torchrl_nerd.geometry.base import keep_constants
from torchrl_nerd.geometry.constants import take
from torchrl_nerd.geometry.manifold import HINGE, SLIDE
from torchrl_nerd.modules.symmetric import SignedCopies
from torchrl_nerd.scenes.scene import Scene

MARGIN = 0.1  # of a range's width, on either side
SPEED_MARGIN = 2.0  # times the largest speed in the data
UNBOUNDED = 1e300  # finite, so that a share of it is a number
MAX_POSITION = 1e6  # m and rad: beyond it the state is broken, no joint overshot
TINY = 1e-30  # m/s and rad/s: a dof that never moves in the data stays at rest
MIN_WIDTH = 1e-3  # of a normalised feature's range, for `TrainingRange.excess`
RIDGE = 1e-3  # variance added to every normalised feature before the inverse
QUANTILE = 0.99  # of training inputs that score at most 1
MAX_SAMPLES = 200_000  # for covariance and quantile


class TrainingRange(nn.Module):
    """Bounds of F features, D targets and a robot's states; bounds nothing until `fit`."""

    feature_low: Tensor
    feature_high: Tensor
    target_low: Tensor
    target_high: Tensor
    speed: Tensor
    qpos_low: Tensor
    qpos_high: Tensor
    is_limited: Tensor

    def __init__(self, scene: Scene, num_features: int, num_outputs: int) -> None:
        super().__init__()
        model, self.vectors = scene.model, vector_dofs(scene)
        is_scalar = np.isin(model.jnt_type, (HINGE, SLIDE))
        joints = np.flatnonzero(is_scalar & (model.jnt_limited != 0))
        dofs = model.jnt_dofadr[joints].tolist()
        # addresses in qpos and qvel of limited hinges and slides
        self.limited = tuple(zip(model.jnt_qposadr[joints].tolist(), dofs, strict=True))
        self.joint_of = [0] * model.nv  # qpos of each dof's joint, if limited
        for q, v in self.limited:
            self.joint_of[v] = q
        keep_constants(self, is_limited=np.isin(range(model.nv), dofs))
        one = torch.ones((), dtype=torch.float64)
        sizes = {"feature": num_features, "target": num_outputs, "qpos": scene.model.nq}
        for name, size in sizes.items():
            self.register_buffer(f"{name}_low", one.new_full((size,), -UNBOUNDED))
            self.register_buffer(f"{name}_high", one.new_full((size,), UNBOUNDED))
        self.register_buffer("speed", one.new_full((scene.model.nv,), UNBOUNDED))

    @property
    def is_fitted(self) -> bool:
        """Whether the model knows what it was trained on."""
        # in float32 what is unbounded is as large as a number can be
        unbounded = min(UNBOUNDED, torch.finfo(self.feature_high.dtype).max)
        return bool((self.feature_high < unbounded).all())

    @torch.no_grad()
    def fit(
        self, features: Tensor, targets: Tensor, qpos: Tensor, qvel: Tensor
    ) -> None:
        """Take the bounds of samples ``(n, ...)``, features and targets normalised."""
        for q, _ in self.limited:
            low, high = qpos[:, q].amin(), qpos[:, q].amax()
            margin = MARGIN * (high - low)
            self.qpos_low[q], self.qpos_high[q] = low - margin, high + margin
        for name, x in (("feature", features), ("target", targets)):
            low, high = x.amin(0), x.amax(0)
            margin = MARGIN * (high - low)
            self.get_buffer(f"{name}_low").copy_(low - margin)
            self.get_buffer(f"{name}_high").copy_(high + margin)
        self.speed.copy_(SPEED_MARGIN * magnitudes(self.vectors, qvel).amax(0))

    @torch.no_grad()
    def widen(self, other: "TrainingRange") -> None:
        """Include another one's bounds; unchanged where that one was never fitted."""
        if not other.is_fitted:
            return
        for name, mine in self.named_buffers():  # lower bounds, upper ones and speeds
            wider = torch.minimum if name.endswith("_low") else torch.maximum
            mine.copy_(wider(mine, other.get_buffer(name).to(mine.device)))

    def clamp_features(self, features: Tensor) -> Tensor:
        """Normalised features ``(*batch, F)`` within the range; NaN stays."""
        return features.clamp(self.feature_low, self.feature_high)

    def clamp_target(self, target: Tensor) -> Tensor:
        """Normalised changes of the state ``(*batch, D)`` within the range."""
        return target.clamp(self.target_low, self.target_high)

    def clamp_change(self, change: Tensor, step: float) -> Tensor:
        """Changes ``(*batch, 2 nv)`` within those from the largest speed to its opposite.

        ``step`` is the time that they take, s; see `StateDelta`.
        """
        largest = torch.cat((2.0 * self.speed, step * self.speed))
        return change.clamp(-largest, largest)

    def limit_motion(self, motion: Tensor, time: float) -> Tensor:
        """Motions ``(*batch, nv)`` within what the largest speed reaches in ``time`` s."""
        farthest = time * self.speed
        size = magnitudes(self.vectors, motion)
        ratio = farthest / torch.maximum(size, farthest).clamp_min(TINY)
        return motion * ratio

    def stop_joints(self, qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
        """The state with limited joints no farther than in the data, and none going on."""
        if not self.limited:
            return qpos, qvel
        within = qpos.clamp(self.qpos_low, self.qpos_high)
        within = torch.where(qpos.abs() < MAX_POSITION, within, qpos)  # faults stay
        back = take(within - qpos, self.joint_of) * self.is_limited  # (*batch, nv)
        slow = torch.where(back > 0.0, qvel.clamp_min(0.0), qvel)
        return within, torch.where(back < 0.0, slow.clamp_max(0.0), slow)

    def excess(self, features: Tensor) -> Tensor:
        """How far outside the range the farthest feature lies, in widths ``(*batch,)``."""
        low, high = self.feature_low, self.feature_high
        outside = torch.maximum(low - features, features - high).clamp(min=0.0)
        return (outside / (high - low).clamp(min=MIN_WIDTH)).amax(-1)


class OODScore(nn.Module):
    """Mahalanobis distance to F normalised features of training; zero until `fit`."""

    center: Tensor
    whitening: Tensor
    reach: Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        one = torch.ones((), dtype=torch.float64)
        self.register_buffer("center", one.new_zeros(num_features))
        # the largest buffer of most models: float32 is exact enough for a score
        self.register_buffer("whitening", torch.zeros(num_features, num_features))
        self.register_buffer("reach", one)

    @torch.no_grad()
    def fit(self, features: Tensor, copies: SignedCopies | None = None) -> None:
        """Take mean, covariance and quantile of ``(samples, F)``.

        With symmetric ``copies`` of the samples the mean and covariance are of all of
        them, and a copy's score is that of the original.
        """
        some = features[:: -(-len(features) // MAX_SAMPLES) or 1].double()
        own = torch.arange(some.shape[1], device=some.device)[None]
        sources, signs = copies or (own, torch.ones_like(own))  # (K, F)
        center = (signs * some.mean(0)[sources]).mean(0)
        self.center.copy_(center)
        around = some - center
        covariance = around.T @ around / len(some)
        pairs = covariance[sources[:, :, None], sources[:, None]]  # (K, F, F)
        covariance = (signs[:, :, None] * signs[:, None] * pairs).mean(0)
        ridge = RIDGE * torch.eye(some.shape[1], dtype=some.dtype, device=some.device)
        values, axes = torch.linalg.eigh(covariance + ridge)
        # the ridge bounds eigenvalues from below, but for rounding beside a huge one
        self.whitening.copy_((axes / values.clamp_min(RIDGE).sqrt()).T)
        length = self.mahalanobis(some)
        self.reach.copy_(torch.quantile(length, QUANTILE))

    def mahalanobis(self, features: Tensor) -> Tensor:
        """Distance ``(*batch,)`` from the mean in units of the data's spread."""
        around = features - self.center
        white = around @ self.whitening.T.to(around.dtype)
        return torch.linalg.vector_norm(white, dim=-1)

    def forward(self, features: Tensor, excess: Tensor) -> Tensor:
        """Score ``(*batch,)``: up to 1 for 99% of training, above 1 outside the range.

        The sum of both parts predicts large one-step errors best, see docs/stability.md.
        ``excess (*batch,)`` is that of `TrainingRange.excess`.
        """
        spread = self.mahalanobis(features) / self.reach
        return torch.where(excess > 0.0, 1.0 + spread + excess.sqrt(), spread)


class Sleep(nn.Module):
    """Thresholds below which a robot over a ground stays exactly where it is.

    As in game and robot engines: no solver's rest is exact, and a learned one's noise
    would carry a resting robot away in time. Thresholds are zero until set.

    | buffer | meaning |
    |---|---|
    | ``sleep_speed`` | ``(nv,)``, m/s and rad/s: speed of the model's noise at rest |
    | ``sleep_gain`` | ``(nv,)``: speed that the model adds to a resting robot in a step;
      one that gains more begins to move, as on a slope that friction does not hold |

    A robot without a ground never sleeps.
    """

    sleep_speed: Tensor
    sleep_gain: Tensor

    def __init__(self, scene: Scene) -> None:
        super().__init__()
        self.vectors, self.can_rest = vector_dofs(scene), scene.terrain is not None
        zero = torch.zeros(scene.model.nv, dtype=torch.float64)
        self.register_buffer("sleep_speed", zero)
        self.register_buffer("sleep_gain", zero.clone())

    def is_asleep(self, before: Tensor, after: Tensor) -> Tensor:
        """Where ``qvel (*batch, nv)`` before and after a step counts as rest."""
        old, new = (magnitudes(self.vectors, qvel) for qvel in (before, after))
        is_slow = torch.maximum(old, new) < self.sleep_speed
        return (is_slow & (new - old < self.sleep_gain)).all(-1)

    def apply_sleep(
        self, before: tuple[Tensor, Tensor], after: tuple[Tensor, Tensor]
    ) -> tuple[Tensor, Tensor]:
        """The state after, or the one before at zero velocity where the robot sleeps."""
        if not self.can_rest:
            return after
        is_asleep = self.is_asleep(before[1], after[1])[..., None]
        qpos = torch.where(is_asleep, before[0], after[0])
        return qpos, after[1].masked_fill(is_asleep, 0.0)


def magnitudes(vectors: tuple[int, ...], qvel: Tensor) -> Tensor:
    """Magnitudes ``(*batch, nv)`` of ``qvel``; of whole vectors at `vector_dofs`."""
    sizes = qvel.abs()
    for start in vectors:
        norm = torch.linalg.vector_norm(qvel[..., start : start + 3], dim=-1)
        sizes[..., start : start + 3] = norm[..., None]
    return sizes


def vector_dofs(scene: Scene) -> tuple[int, ...]:
    """Where in ``qvel`` the three components of each vector begin."""
    layout = scene.layout
    return (*layout.translations, *(v for _, v in layout.rotations))
