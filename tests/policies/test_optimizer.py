"""The fused step is AdamW's."""

import torch
from lerobot.optim import AdamWConfig

from lerobot_uca.policies.optimizer import FusedAdamWConfig


def test_the_fused_step_is_lerobots():
    settings = {"lr": 1e-2, "betas": (0.9, 0.99), "eps": 1e-6, "weight_decay": 0.1, "grad_clip_norm": 1.0}
    start = torch.randn(7, 5)
    results = []
    for config in (AdamWConfig(**settings), FusedAdamWConfig(**settings)):
        weight = torch.nn.Parameter(start.clone())
        optimizer = config.build([weight])
        assert bool(optimizer.param_groups[0]["fused"]) == isinstance(config, FusedAdamWConfig)
        for step in range(5):
            optimizer.zero_grad()
            (weight.sin() * (step + 1)).sum().backward()
            optimizer.step()
        results.append(weight.detach())
    torch.testing.assert_close(*results)
    assert not torch.allclose(results[0], start, atol=1e-2)
