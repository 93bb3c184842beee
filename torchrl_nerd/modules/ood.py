"""Out-of-distribution score of a model's input."""

import torch
from torch import Tensor, nn

RIDGE = 1e-3  # variance added to every normalised feature before the inverse
QUANTILE = 0.99  # of training inputs that score at most 1
MAX_SAMPLES = 200_000  # for covariance and quantile


class OODScore(nn.Module):
    """Mahalanobis distance to the training features, scaled; zero until `fit`.

    Args:
        num_features: width F of normalised features.
    """

    center: Tensor
    whitening: Tensor
    reach: Tensor

    def __init__(self, num_features: int) -> None:
        super().__init__()
        one = torch.ones((), dtype=torch.float64)
        self.register_buffer("center", one.new_zeros(num_features))
        self.register_buffer("whitening", one.new_zeros(num_features, num_features))
        self.register_buffer("reach", one)

    @torch.no_grad()
    def fit(self, features: Tensor) -> None:
        """Take mean, covariance and quantile of ``(samples, F)``."""
        some = features[:: max(1, len(features) // MAX_SAMPLES)].double()
        center = some.mean(0)
        covariance = (some - center).T @ (some - center) / len(some)
        ridge = RIDGE * torch.eye(len(center), dtype=some.dtype, device=some.device)
        values, axes = torch.linalg.eigh(covariance + ridge)
        self.center.copy_(center)
        # the ridge bounds eigenvalues from below, but for rounding beside a huge one
        self.whitening.copy_((axes / values.clamp_min(RIDGE).sqrt()).T)
        length = self.mahalanobis(some.to(features.dtype))
        self.reach.copy_(torch.quantile(length, QUANTILE))

    def mahalanobis(self, features: Tensor) -> Tensor:
        """Distance ``(*batch,)`` from the mean in units of the data's spread."""
        return torch.linalg.vector_norm(
            (features - self.center) @ self.whitening.T, dim=-1
        )

    def forward(self, features: Tensor, excess: Tensor) -> Tensor:
        """Score ``(*batch,)``: up to 1 for 99% of training, above 1 outside the range.

        The sum of both parts predicts large one-step errors best, see docs/stability.md.

        Args:
            features: normalised, ``(*batch, F)``.
            excess: ``(*batch,)``, see `TrainingRange.excess`.
        """
        spread = self.mahalanobis(features) / self.reach
        return torch.where(excess > 0.0, 1.0 + spread + excess.sqrt(), spread)
