"""From point clouds and robot states to one feature vector for each observation step.

Letters: B samples, O observation steps, N points, S state dimensions, F features.
"""

import torch
from torch import Tensor, nn


class PointEncoder(nn.Module):
    """A small PointNet, the same in DP3, FlowPolicy and MP1: per-point layers, max over the points, projection.

    The order of the points does not matter.
    """

    def __init__(self, widths: tuple[int, ...], n_features: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for n_in, n_out in zip((3, *widths[:-1]), widths, strict=True):
            layers += [nn.Linear(n_in, n_out), nn.LayerNorm(n_out), nn.ReLU()]
        self.per_point = nn.Sequential(*layers)
        self.project = nn.Sequential(nn.Linear(widths[-1], n_features), nn.LayerNorm(n_features))

    def forward(self, points: Tensor) -> Tensor:
        """(..., N, 3) to (..., F)."""
        return self.project(self.per_point(points).amax(dim=-2))


class ObservationEncoder(nn.Module):
    """[point-cloud feature; state feature] for each observation step (paper section 3.2)."""

    def __init__(
        self, n_states: int, point_widths: tuple[int, ...], n_point_features: int, n_state_features: int
    ) -> None:
        super().__init__()
        self.points = PointEncoder(point_widths, n_point_features)
        self.state = nn.Sequential(
            nn.Linear(n_states, n_state_features), nn.ReLU(), nn.Linear(n_state_features, n_state_features)
        )

    def forward(self, point_cloud: Tensor, state: Tensor) -> Tensor:
        """point_cloud (B, O, N, 3) and state (B, O, S) to (B, O, F)."""
        return torch.cat([self.points(point_cloud), self.state(state)], dim=-1)
