import torch

from lerobot_uca.objectives.mean_square import mean_square


def test_mean_over_the_steps_that_count():
    error = torch.randn(2, 4, 3)
    mask = torch.tensor([[True, True, True, True], [False, True, True, False]])
    expected = torch.stack([error[0].square().mean(), error[1, 1:3].square().mean()])
    torch.testing.assert_close(mean_square(error, mask), expected)


def test_a_sample_without_steps_that_count_has_no_error():
    mask = torch.tensor([[True, True], [False, False]])
    assert mean_square(torch.ones(2, 2, 3), mask).tolist() == [1, 0]
