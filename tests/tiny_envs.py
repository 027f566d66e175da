"""Environments small enough for tests, registered when this module is imported."""

import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path

import gymnasium as gym
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiBinary, MultiDiscrete, OneOf, Sequence, Text, Tuple


class TinyPixels(gym.Env):
    """A bright column moves left or right; the left edge pays and ends the episode.

    Actions: 0 left, 1 right. Reward: 1 at the left edge. `max_episode_steps` truncates. It begins in column `start`, or
    at random.
    """

    action_space = Discrete(2)

    def __init__(self, channels: int | None = 3, start: int | None = None):
        self.start = start
        shape = (36, 48) if channels is None else (36, 48, channels)
        self.observation_space = Box(0, 255, shape, np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.column = self.start or int(self.np_random.integers(4, 12))
        return self.screen(), {}

    def step(self, action):
        self.column = min(15, self.column + (1 if action == 1 else -1))
        reached = self.column == 0
        return self.screen(), float(reached), reached, False, {}

    def screen(self):
        screen = np.zeros(self.observation_space.shape, np.uint8)
        screen[:, 3 * self.column : 3 * self.column + 3] = 255
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


class Shows(gym.Env):
    """Observes samples of a space, and pays an action's number; an action of another space, or type, is an error."""

    def __init__(self, space: gym.Space, start: int = 0):
        self.observation_space, self.action_space = space, Discrete(2, start=start, dtype=np.int8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert action in self.action_space
        return self.observation_space.sample(), float(action), False, False, {}


NUMBERS = {
    "Cell": Discrete(3, start=5),
    "Number": Box(0, 1, ()),
    "Switches": MultiBinary((2, 3)),
    "Counts": MultiDiscrete([2, 3]),
    "Grid": Box(0, 10, (7, 7, 3), np.uint8),
    "Wide": Box(0, 255, (35, 84), np.uint8),
    "FourChannels": Box(0, 255, (84, 84, 4), np.uint8),
    "Nested": Dict(place=Tuple([Discrete(4), Box(-1, 1, (2, 2), np.float64)]), image=Box(0, 255, (40, 40), np.uint8)),
}
NO_NUMBERS = {
    "Mission": Dict(image=Box(0, 10, (7, 7, 3), np.uint8), mission=Text(9)),
    "Deep": Tuple([Discrete(2), Dict(links=Graph(Box(0, 1, (1,)), None), turns=Sequence(Discrete(2)))]),
    "Either": OneOf([Discrete(2), Box(0, 1, (2,))]),
    "Empty": Box(0, 1, (0,)),
}


class Awkward(gym.Env):
    """A program of somebody else's: games of ten steps, in which it does what its trait says."""

    observation_space, action_space = Box(-1, 1, (2,), np.float64), Discrete(2)
    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}
    exists = False

    def __init__(self, trait: str, render_mode: str | None = None):
        self.trait, self.render_mode, self.steps, self.renders = trait, render_mode, 0, 0
        if trait == "exists once":
            assert not Awkward.exists, "the port is in use"
            Awkward.exists = True
        if trait == "leaves":
            os.chdir("..")
        if trait == "takes signals":
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: None)
        if trait == "forks":
            self.child = multiprocessing.get_context("fork").Process(target=time.sleep, args=(3600,), daemon=True)
            self.child.start()

    def observe(self) -> np.ndarray:
        if self.trait == "draws globally":
            return np.array([np.random.uniform(), random.random()]) + self.action_space.sample()
        return self.np_random.uniform(size=2)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observe(), {}

    def step(self, action):
        self.steps += 1
        if self.steps == 100:
            if self.trait == "raises":
                raise RuntimeError("simulator\nlost")
            if self.trait == "exits":
                sys.exit()
            Path("step-100").touch()
        result = self.observe(), 1.0, self.steps % 10 == 0, False, {}
        return (*result[:3], {"lives": 3}) if self.trait == "is old" else result

    def render(self):
        self.renders += 1
        if self.trait == "renders no more" and self.renders > 3:
            raise RuntimeError("no screen")
        return np.zeros((40, 60, 3), np.uint8)

    def close(self):
        Awkward.exists = False
        if self.trait == "does not close":
            raise RuntimeError("already gone")
        if self.trait == "forks":
            self.child.terminate()
            self.child.join()


TRAITS = ["takes signals", "forks", "draws globally", "raises", "exits", "leaves", "is old", "renders no more"]
for trait in [*TRAITS, "does not close", "exists once"]:
    gym.register(f"{trait.title().replace(' ', '')}-v0", Awkward, disable_env_checker=True, kwargs={"trait": trait})
gym.register("CountsFromFive-v0", Shows, kwargs={"space": Box(-1, 1, (1,)), "start": 5})
gym.register("Endless-v0", Endless)
gym.register("RenderedPixels-v0", RenderedPixels, max_episode_steps=20)
gym.register("SameGame-v0", TinyPixels, max_episode_steps=2, kwargs={"start": 2})  # of two steps, whatever the seed
gym.register("ShortCartPole-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv", max_episode_steps=15)
gym.register("ShowsMuch-v0", Shows, kwargs={"space": Box(-1, 1, (1_000_000,))})
for name, space in (NUMBERS | NO_NUMBERS).items():
    gym.register(f"Shows{name}-v0", Shows, kwargs={"space": space})
gym.register("TinyPixels-v0", TinyPixels, max_episode_steps=20)
gym.register("TinyPixelsGrey-v0", TinyPixels, max_episode_steps=20, kwargs={"channels": None})
gym.register("TinyPixelsOneChannel-v0", TinyPixels, max_episode_steps=20, kwargs={"channels": 1})
