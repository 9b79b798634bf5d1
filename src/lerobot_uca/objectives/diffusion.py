"""DP3's objective: a diffusion model that predicts the clean actions, sampled by DDIM.

Time is a diffusion step k in 0 .. K - 1: the last one is noise. Letters: B samples, T horizon, A action dimensions.
"""

from collections.abc import Callable

import torch
from diffusers.schedulers.scheduling_ddim import DDIMScheduler
from torch import Tensor

from lerobot_uca.objectives.mean_square import mean_square

DenoisingNetwork = Callable[[Tensor, Tensor, Tensor], Tensor]
"""The clean actions, from z (B, T, A), k (B,) and o (B, ...) to (B, T, A)."""


def make_scheduler(n_training_steps: int) -> DDIMScheduler:
    """The baselines' noise schedule; actions are normalised to [-1, 1], which is what `clip_sample` clips to."""
    return DDIMScheduler(
        num_train_timesteps=n_training_steps,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        clip_sample=True,
    )


def diffusion_loss(network: DenoisingNetwork, scheduler: DDIMScheduler, x: Tensor, o: Tensor, mask: Tensor) -> Tensor:
    """The squared error of the predicted clean actions at a random step, (B,).

    Args:
        x: (B, T, A) expert actions, normalised. o: (B, ...). mask: (B, T), True for steps that count.
    """
    k = torch.randint(len(scheduler.alphas_cumprod), (len(x),), device=x.device)
    z = scheduler.add_noise(x, torch.randn_like(x), k)  # type: ignore[arg-type]  # any integers do
    return mean_square(network(z, k, o) - x, mask)


def ddim_sample(
    network: DenoisingNetwork, scheduler: DDIMScheduler, noise: Tensor, o: Tensor, *, n_steps: int
) -> Tensor:
    """Actions (B, T, A) from noise in n_steps calls of the network, without further noise."""
    scheduler.set_timesteps(n_steps)
    z = noise
    for k, on_device in zip(scheduler.timesteps, scheduler.timesteps.to(z.device), strict=True):
        x = network(z, on_device.expand(len(z)), o)
        z = scheduler.step(x, k, z, return_dict=False)[0]
    return z
