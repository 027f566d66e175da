"""Environments small enough for tests, registered when this module is imported."""

import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Discrete


class TinyPixels(gym.Env):
    """A bright column moves left or right; the left edge pays and ends the episode.

    Actions: 0 left, 1 right. Reward: 1 at the left edge. `max_episode_steps` truncates.
    """

    action_space = Discrete(2)

    def __init__(self, channels: int | None = 3):
        shape = (12, 16) if channels is None else (12, 16, channels)
        self.observation_space = Box(0, 255, shape, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.column = int(self.np_random.integers(4, 12))
        return self.screen(), {}

    def step(self, action):
        self.column = min(15, self.column + (1 if action == 1 else -1))
        reached = self.column == 0
        return self.screen(), float(reached), reached, False, {}

    def screen(self):
        screen = np.zeros(self.observation_space.shape, np.uint8)
        screen[:, self.column] = 255
        return screen


class RenderedPixels(TinyPixels):
    """The same with a picture for videos."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}

    def __init__(self, render_mode: str | None = None):
        super().__init__()
        self.render_mode = render_mode

    def render(self):
        return self.screen()


class Endless(gym.Env):
    """Nothing happens, for ever; step 100 of a game, which a short training does not reach, leaves a file behind."""

    observation_space = Box(0, 1, (2,), np.float32)
    action_space = Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 100:
            Path("step-100").touch()
        return np.zeros(2, np.float32), 0.0, False, False, {}


class Stuck(Endless):
    """Its first step takes an hour."""

    def step(self, action):
        Path("stuck").touch()
        time.sleep(3600)
        return super().step(action)


class RewardNothing(gym.Env):
    """Every step ends an episode with no reward, so that all returns are 0."""

    observation_space, action_space = Box(-1, 1, (1,)), Discrete(2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        return np.zeros(1, np.float32), 0.0, True, False, {}


class CountsFromFive(gym.Env):
    """Its actions are 5 and 6; anything else is an error."""

    observation_space, action_space = Box(-1, 1, (1,)), Discrete(2, start=5)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(1, np.float32), {}

    def step(self, action):
        assert action in self.action_space
        return np.zeros(1, np.float32), float(action), False, False, {}


class CannotStart(gym.Env):
    """Fails when it is built, or when it is reset."""

    observation_space, action_space = Box(-1, 1, (1,)), Discrete(2)

    def __init__(self, fails_in: str):
        if fails_in == "init":
            raise RuntimeError("no such\nlevel")

    def reset(self, *, seed=None, options=None):
        raise FileNotFoundError("level.txt")


gym.register("CannotBeBuilt-v0", CannotStart, kwargs={"fails_in": "init"})
gym.register("CannotBeReset-v0", CannotStart, kwargs={"fails_in": "reset"})
gym.register("CountsFromFive-v0", CountsFromFive)
gym.register("Endless-v0", Endless)
gym.register("RenderedPixels-v0", RenderedPixels, max_episode_steps=20)
gym.register("RewardNothing-v0", RewardNothing)
gym.register("ShortCartPole-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv", max_episode_steps=15)
gym.register("Stuck-v0", Stuck)
gym.register("TinyPixels-v0", TinyPixels, max_episode_steps=20)
gym.register("TinyPixelsGrey-v0", TinyPixels, max_episode_steps=20, kwargs={"channels": None})
gym.register("TinyPixelsOneChannel-v0", TinyPixels, max_episode_steps=20, kwargs={"channels": 1})
