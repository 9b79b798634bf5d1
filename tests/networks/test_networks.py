import pytest
import torch

from lerobot_uca.networks.observation_encoder import ObservationEncoder, PointEncoder
from lerobot_uca.networks.transformer import Block


def test_points_have_no_order():
    torch.manual_seed(0)
    encoder = PointEncoder((64, 128, 256), 64)
    points = torch.randn(2, 100, 3)
    torch.testing.assert_close(encoder(points[:, torch.randperm(100)]), encoder(points))


def test_repeated_points_change_nothing():
    torch.manual_seed(0)
    encoder = PointEncoder((64, 128, 256), 64)
    points = torch.randn(2, 100, 3)
    torch.testing.assert_close(encoder(torch.cat([points, points[:, :30]], dim=1)), encoder(points))


@pytest.mark.parametrize("n_clouds", [1, 40])
def test_going_back_through_the_winners_alone_gives_the_plain_encoders_gradients(n_clouds):
    torch.manual_seed(0)
    encoder = PointEncoder((64, 128, 256), 64).double()
    with torch.no_grad():
        encoder.per_point[-1].bias[:20] = -10  # features that no point has
    points = torch.randn(n_clouds, 2, 100, 3, dtype=torch.float64)
    points[:, :, 50:60] = points[:, :, :10]  # points that share a victory
    weight = torch.randn(n_clouds, 2, 64, dtype=torch.float64)
    parameters = list(encoder.parameters())

    plain = encoder.project(torch.relu(encoder.per_point(points)).amax(dim=-2))
    expected = torch.autograd.grad((plain * weight).sum(), parameters)
    features = encoder(points)
    torch.testing.assert_close(features, plain)
    for got, gradient in zip(torch.autograd.grad((features * weight).sum(), parameters), expected, strict=True):
        torch.testing.assert_close(got, gradient)
    with torch.no_grad():
        torch.testing.assert_close(encoder(points), plain)


def test_skipping_unread_tokens_changes_no_action():
    torch.manual_seed(0)
    block = Block(dim=16, n_heads=2)
    tokens = torch.randn(2, 10, 16)
    torch.testing.assert_close(block(tokens, n_out=4), block(tokens)[:, -4:])


def test_encoder_has_the_baselines_size():
    encoder = ObservationEncoder(9, (64, 128, 256), 64, 64)
    linear = (3 + 1) * 64 + (64 + 1) * 128 + (128 + 1) * 256 + (256 + 1) * 64
    norms = 2 * (64 + 128 + 256 + 64)
    state = (9 + 1) * 64 + (64 + 1) * 64
    assert sum(parameter.numel() for parameter in encoder.parameters()) == linear + norms + state
