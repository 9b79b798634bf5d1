"""The scripted teleoperator with a recording's calls, timed as LeRobot's loops time them."""

import numpy as np
import pytest

from lerobot_uca.robots.ur5e.sim import scripted_teleoperator
from lerobot_uca.robots.ur5e.sim.config_scripted_teleoperator import ScriptedTeleoperatorConfig
from lerobot_uca.robots.ur5e.sim.robot import HOME
from lerobot_uca.robots.ur5e.sim.scripted_teleoperator import ScriptedTeleoperator

FPS, EPISODE, RESET = 30, 5.0, 3.0


class World:
    """Places for the things, another drawer each time; counts how often."""

    n_resets = 0

    def __init__(self, ip):
        del ip

    def ask(self, **request):
        self.n_resets += request["request"] == "reset"
        return {"cube": [-0.5, -0.1, 0.02, 0.0], "drawer": [0.09 + 0.001 * self.n_resets]}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("saving", [0.4, 1.5], ids=["fast", "slow"])  # [s], an episode
def test_every_episode_is_one_demonstration_from_home(tmp_path, monkeypatch, saving, seed):
    """With the jitter of a busy computer: every loop's first step takes long, others up to twice their time."""
    monkeypatch.setattr(scripted_teleoperator, "SceneClient", World)
    rng, now = np.random.default_rng(seed), 0.0
    config = ScriptedTeleoperatorConfig(
        task="drawer_close", fps=FPS, episode_time_s=EPISODE, reset_time_s=RESET, calibration_dir=tmp_path
    )
    teleop = ScriptedTeleoperator(config, clock=lambda: now)
    teleop.connect()

    def loop(seconds):
        nonlocal now
        start, rows = now, []
        while now - start < seconds:
            now += 0.004 if rows else rng.uniform(0, 0.15)  # an observation
            rows.append(list(teleop.get_action().values()))
            now += rng.choice([1, 1.2, 2], p=[0.9, 0.05, 0.05]) / FPS
        return np.array(rows)

    for _ in range(8):
        episode = loop(EPISODE)
        assert np.abs(episode[:2, :6] - HOME).max() < 0.01
        closing = episode[np.abs(np.diff(episode, axis=0, prepend=episode[:1])).max(axis=1) > 1e-9]
        assert 70 < len(closing) < 85
        still = episode[np.abs(episode - closing[-2]).max(axis=1) < 0.01]
        assert len(still) > 30  # it has ended, and the way home has not begun
        loop(RESET)
        now += saving
