"""The fused step is AdamW's."""

import torch
from lerobot.optim import AdamWConfig

from lerobot_uca.policies.configuration_uca_flow import UCAFlowConfig
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


def test_the_configurations_options_reach_optimiser_and_schedule():
    wanted = {"lr": 0.3, "betas": (0.1, 0.2), "eps": 0.4, "weight_decay": 0.5, "grad_clip_norm": 0.6}
    options = {f"optimizer_{name}": value for name, value in wanted.items()}
    config = UCAFlowConfig(device="cpu", push_to_hub=False, scheduler_warmup_steps=7, **options)
    preset = config.get_optimizer_preset()
    assert {name: getattr(preset, name) for name in wanted} == wanted
    assert config.get_scheduler_preset().num_warmup_steps == 7
