import torch

from lerobot_uca.networks.observation_encoder import ObservationEncoder, PointEncoder


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


def test_encoder_has_the_baselines_size():
    encoder = ObservationEncoder(9, (64, 128, 256), 64, 64)
    linear = (3 + 1) * 64 + (64 + 1) * 128 + (128 + 1) * 256 + (256 + 1) * 64
    norms = 2 * (64 + 128 + 256 + 64)
    state = (9 + 1) * 64 + (64 + 1) * 64
    assert sum(parameter.numel() for parameter in encoder.parameters()) == linear + norms + state
