"""The encoder: point clouds and robot states become one feature vector for each observation step.

Letters: B samples, O observation steps, N points, S state dimensions, F features.
"""

import torch
from torch import Tensor, nn

CPU_CLOUDS = 16  # at once: what they need stays in a CPU's cache; with more, the forward pass is twice as slow


class PointEncoder(nn.Module):
    """A small PointNet, the same in DP3, FlowPolicy and MP1: `project(relu(per_point(p)).amax(-2))`.

    The order of the points does not matter. A point receives a gradient only through the features in which it has its
    cloud's largest value. So training finds these winners, 20 to 40 % of the points, without a graph, and computes only
    them once more to differentiate: the same gradients for less time.

    Points have 3 channels, xyz, or 6 with RGB.
    """

    def __init__(self, widths: tuple[int, ...], n_features: int, n_channels: int = 3) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for n_in, n_out in zip((n_channels, *widths[:-1]), widths, strict=True):
            layers += [nn.Linear(n_in, n_out), nn.LayerNorm(n_out), nn.ReLU()]
        self.per_point = nn.Sequential(*layers[:-1])
        # The last ReLU comes after the maximum: the same result, on far fewer values.
        self.project = nn.Sequential(nn.ReLU(), nn.Linear(widths[-1], n_features), nn.LayerNorm(n_features))

    def forward(self, points: Tensor) -> Tensor:
        """(..., N, 3) to (..., F)."""
        clouds = points.flatten(0, -3)
        largest = self._largest_of_winners if torch.is_grad_enabled() else self._largest
        return self.project(largest(clouds).unflatten(0, points.shape[:-2]))

    def _largest(self, clouds: Tensor) -> Tensor:
        """(B, N, 3) to (B, C)."""
        return torch.cat([_largest_point(self.per_point(some)) for some in _some_at_once(clouds)])

    def _largest_of_winners(self, clouds: Tensor) -> Tensor:
        """The same values, (B, N, 3) to (B, C), with a graph for the gradients."""
        with torch.no_grad():
            winners = torch.cat([self.per_point(some).max(dim=1).indices for some in _some_at_once(clouds)])
        # Autocast keeps the weights that it has converted, and older PyTorch (2.7) would take these, which have no
        # graph, again below: the layers would not be trained.
        torch.clear_autocast_cache()
        wins = torch.zeros(clouds.shape[:2], dtype=torch.bool, device=clouds.device).scatter_(1, winners, True)
        row = wins.flatten().cumsum(0).view_as(wins) - 1  # of a winner in the list of all winners
        return self.per_point(clouds[wins]).gather(0, row.gather(1, winners))


def _largest_point(features: Tensor) -> Tensor:
    """features.amax(dim=1), (B, N, C) to (B, C). By groups, which ONNX Runtime does three times faster."""
    size = max(1, features.shape[1] // 8)
    n_grouped = features.shape[1] // size * size
    groups = features[:, :n_grouped].unflatten(1, (-1, size)).amax(dim=2)
    return torch.cat([groups, features[:, n_grouped:]], dim=1).amax(dim=1)


def _some_at_once(clouds: Tensor) -> tuple[Tensor, ...]:
    return clouds.split(CPU_CLOUDS) if clouds.device.type == "cpu" else (clouds,)


class ObservationEncoder(nn.Module):
    """[point-cloud feature; state feature] for each observation step (paper section 3.2)."""

    def __init__(
        self,
        n_states: int,
        point_widths: tuple[int, ...],
        n_point_features: int,
        n_state_features: int,
        n_channels: int = 3,
    ) -> None:
        super().__init__()
        self.points = PointEncoder(point_widths, n_point_features, n_channels)
        self.state = nn.Sequential(
            nn.Linear(n_states, n_state_features), nn.ReLU(), nn.Linear(n_state_features, n_state_features)
        )

    def forward(self, point_cloud: Tensor, state: Tensor) -> Tensor:
        """point_cloud (B, O, N, 3) and state (B, O, S) to (B, O, F)."""
        return torch.cat([self.points(point_cloud), self.state(state)], dim=-1)
