"""The environments: real games step by step against a reference, names, seeds, and what is refused."""

import math
import sys

import ale_py
import cv2
import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete, flatdim
from gymnasium.spaces.utils import flatten

from tiny_envs import NUMBERS
from wrappers import EnvironmentFailed, atari_specs, env_seeds, find_atari_game, make_envs


class ReferenceGame:
    """One game of the thesis's protocol, frame by frame on `ALEInterface`, written from the protocol's description."""

    def __init__(self, rom: str, seed: int, max_frames: int = 108_000):
        self.ale = ale_py.ALEInterface()
        self.ale.setLoggerMode(ale_py.LoggerMode.Error)
        self.ale.setInt("random_seed", seed)
        self.ale.setFloat("repeat_action_probability", 0.0)
        self.ale.loadROM(ale_py.roms.get_rom_path(rom))
        self.actions = self.ale.getMinimalActionSet()
        self.max_frames = max_frames

    def reset(self, frames: int) -> None:
        """Starts a game with no-ops up to a frame number: how many there are, ale-py's own random generator draws."""
        self.ale.reset_game()
        while self.ale.getEpisodeFrameNumber() < frames:
            self.ale.act(ale_py.Action.NOOP)
        self.score, self.frames, self.steps = 0, 0, 0  # ale-py counts the frames of its limit after the no-ops
        self.life_starts = True
        blank = np.zeros((84, 84), np.uint8)
        self.stack = [blank, blank, blank, self.shrink(self.ale.getScreenGrayscale())]

    def step(self, action: int) -> None:
        """Plays one agent step and leaves reward, life_lost, over, truncated and the stack of screens behind."""
        pressed = self.actions[action]
        if self.life_starts and ale_py.Action.FIRE in self.actions:
            pressed = ale_py.Action.FIRE
        lives_before, self.reward, screens = self.ale.lives(), 0, []
        for _ in range(4):
            self.reward += self.ale.act(pressed)
            screens.append(self.ale.getScreenGrayscale())
            self.frames += 1
            if self.ale.game_over():
                break
        self.score += self.reward
        self.steps += 1
        self.over = self.ale.game_over()
        self.truncated = not self.over and self.frames >= self.max_frames
        if self.truncated:  # ale-py stops before it sees the last frame, as Gymnasium's AtariPreprocessing does
            screens = [self.pooled, screens[2]]
        self.pooled = np.maximum(*(screens * 2)[-2:])
        self.stack = [*self.stack[1:], self.shrink(self.pooled)]
        self.life_lost = not self.over and not self.truncated and 0 < self.ale.lives() < lives_before
        self.life_starts = self.life_lost

    @staticmethod
    def shrink(screen: np.ndarray) -> np.ndarray:
        return cv2.resize(screen, (84, 84), interpolation=cv2.INTER_AREA)


@pytest.mark.parametrize(
    ("rom", "num_steps", "expect"),
    [
        ("breakout", 260, {"game", "life"}),  # lives and FIRE
        ("pong", 900, {"game"}),  # no lives
        ("frogger", 350, {"game", "life", "waits at 0 lives"}),
        ("double_dunk", 150, {"game", "truncation"}),  # no lives, and games too long to wait for their end
        ("breakout", 150, {"game", "life", "truncation"}),
    ],
)
def test_games_match_a_frame_by_frame_reference(rom, num_steps, expect):
    num_envs, random = 2, np.random.default_rng(7)
    max_frames = 400 if "truncation" in expect else 108_000
    envs = make_envs(rom, num_envs, max_frames=max_frames)
    seeds = env_seeds(3, num_envs)
    obs, infos = envs.reset(seed=seeds)
    games = [ReferenceGame(rom, seed, max_frames) for seed in seeds]
    for game, frames in zip(games, infos["episode_frame_number"]):
        game.reset(frames)
    assert np.array_equal(obs, [game.stack for game in games])

    seen = set()
    for _ in range(num_steps):
        actions = random.integers(0, envs.single_action_space.n, num_envs)
        obs, rewards, terminations, truncations, infos = envs.step(actions)
        for i, game in enumerate(games):
            game.step(actions[i])
            assert rewards[i] == np.sign(game.reward) and rewards.dtype == np.float32
            assert terminations[i] == (game.over or game.life_lost)
            assert truncations[i] == game.truncated
            assert infos.get("_episode", np.zeros(num_envs, bool))[i] == (game.over or game.truncated)
            if game.truncated:
                assert np.array_equal(infos["final_obs"][i], game.stack)
                seen.add("truncation")
            if game.life_lost:
                seen.add("life")
            if not game.over and not game.truncated and game.ale.lives() == 0:
                seen.add("waits at 0 lives")
            if game.over or game.truncated:
                assert infos["episode"]["r"][i] == game.score
                assert infos["episode"]["l"][i] == game.steps
                seen.add("game")
                game.reset(infos["episode_frame_number"][i])
            assert infos["lives"][i] == game.ale.lives()
            assert np.array_equal(obs[i], game.stack)
    assert expect <= seen


def test_a_game_starts_with_0_to_29_noops():
    """The seed is chosen: among its games are one with the fewest no-ops and one with the most that there can be."""
    frames = make_envs("Breakout", 5).reset(seed=env_seeds(1, 5))[1]["episode_frame_number"]
    assert (frames.min(), frames.max()) == (0, 29)


def test_every_registered_game_is_found_by_its_bare_name():
    assert find_atari_game("ALE/Breakout-v5") == find_atari_game("ale_py:ALE/Breakout-v5") == ("breakout", 0.25)
    assert find_atari_game("BreakoutNoFrameskip-v4") == find_atari_game("breakout") == ("breakout", 0.0)
    assert find_atari_game("Blackjack-v1") is None  # Gymnasium's own, not Atari's game of that name
    specs = atari_specs().values()
    assert len(specs) == 104
    for spec in specs:
        assert find_atari_game(spec.name) == find_atari_game(spec.kwargs["game"]) == (spec.kwargs["game"], 0.0)


@pytest.mark.parametrize(
    ("env_id", "message"),
    [
        ("Brekout", "did you mean Breakout"),
        ("combat", "no mode for one player"),
        ("MazeCraze", "no mode for one player"),
        ("Breakout-v4", "use Breakout, or ALE/Breakout-v5"),
        ("BreakoutDeterministic-v4", "use Breakout, or ALE/Breakout-v5"),
        ("BreakoutNoFrameskip-v0", "use Breakout, or ALE/Breakout-v5"),
        ("Pendulum-v1", "only Discrete actions"),
        ("tiny_envs:ShowsMission-v0", "its observations are Dict.*, not numbers"),
        ("tiny_envs:ShowsDeep-v0", "its observations are Tuple.*, not numbers"),
        ("tiny_envs:ShowsEither-v0", "its observations are OneOf.*, not numbers"),
        ("tiny_envs:ShowsEmpty-v0", "its observations are Box.*, not numbers"),
        ("no_such_module:Env-v0", "No module named 'no_such_module'"),
    ],
)
def test_what_cannot_be_played_is_refused_by_name(env_id, message):
    with pytest.raises(ValueError, match=message):
        make_envs(env_id, 2)


@pytest.mark.parametrize("env_id", ["TinyPixels-v0", "TinyPixelsGrey-v0", "TinyPixelsOneChannel-v0"])
def test_other_images_become_stacked_grey_screens(env_id):
    envs = make_envs(f"tiny_envs:{env_id}", 3)
    obs, _ = envs.reset(seed=env_seeds(1, 3))
    assert obs.shape == (3, 4, 84, 84) and obs.dtype == np.uint8
    columns = [env.unwrapped.column for env in envs.unwrapped.envs]
    brightest = obs[:, -1].mean(axis=1).argmax(axis=1)  # (N, 84) → the bright column of the newest screen
    assert np.allclose(brightest * 16 / 84, columns, atol=1)
    moved, *_ = envs.step(np.ones(3, int))
    assert np.array_equal(moved[:, :3], obs[:, 1:])  # the oldest screen leaves, the others move up


@pytest.mark.parametrize("name", NUMBERS)
def test_all_numbers_but_screens_become_one_float32_vector(name, monkeypatch):
    """Gymnasium's own function says which."""
    space, shown = NUMBERS[name], []
    sample = type(space).sample
    monkeypatch.setattr(type(space), "sample", lambda self: shown.append(sample(self)) or shown[-1])
    envs = make_envs(f"tiny_envs:Shows{name}-v0", 1)
    shown.clear()
    obs, _ = envs.reset()
    assert envs.single_observation_space.shape == (flatdim(space),)
    assert obs.dtype == np.float32 and np.array_equal(obs[0], flatten(space, shown[-1]).astype(np.float32))


def test_a_module_may_lie_in_the_current_directory(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lies_here.py").write_text(
        'import gymnasium as gym\ngym.register("LiesHere-v0", "gymnasium.envs.classic_control.cartpole:CartPoleEnv")\n'
    )
    assert make_envs("lies_here:LiesHere-v0", 1).single_observation_space.shape == (4,)
    for text, said in (("1 / 0", "division by zero"), ("import sys; sys.exit('no licence')", "no licence")):
        (tmp_path / f"broken{len(text)}.py").write_text(text)
        with pytest.raises(ValueError, match=f"it cannot be built: {said}"):
            make_envs(f"broken{len(text)}:Env-v0", 1)


def test_actions_that_start_elsewhere_are_counted_from_zero():
    envs = make_envs("tiny_envs:CountsFromFive-v0", 2)
    assert envs.single_action_space == Discrete(2)
    envs.reset(seed=[1, 2])
    assert list(envs.step(np.array([0, 1]))[1]) == [5.0, 6.0]


def test_runs_with_neighbouring_seeds_share_no_environment_seed():
    seeds = [number for seed in range(50) for number in env_seeds(seed, 8)]
    assert len(set(seeds)) == len(seeds)
    assert all(type(number) is int and 0 <= number < 2**31 for number in seeds)
    assert env_seeds(1, 8) == env_seeds(1, 8)


class OwnInfos(gym.Env):
    """Has infos of its own under names that the wrappers use; a game is ten steps of reward 1."""

    observation_space, action_space = Box(-math.inf, math.inf, (1,), np.float64), Discrete(2)

    def __init__(self, observation=0.0, reward=1.0, at=7):
        self.observation, self.reward, self.at = observation, reward, at

    def infos(self) -> dict:
        return {"episode": {"r": 0.0, "l": 0}, "_episode": 3, "final_obs": "none", "lives": 2}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1), self.infos()

    def step(self, action):
        self.steps += 1
        observation = np.array([self.observation if self.steps == self.at else 0.0])
        return observation, self.reward if self.steps == self.at else 1.0, self.steps == 10, False, self.infos()


@pytest.fixture
def own_infos():
    gym.register("OwnInfos-v0", OwnInfos)
    yield gym.registry["OwnInfos-v0"]
    del gym.registry["OwnInfos-v0"]


def test_only_the_scores_that_the_wrappers_measure_count(own_infos):
    envs = make_envs("OwnInfos-v0", 2)
    envs.reset(seed=[1, 2])
    infos = [envs.step(np.array([0, 1]))[-1] for _ in range(10)]
    assert all("episode" not in info for info in infos[:-1])
    assert infos[-1]["episode"]["r"].tolist() == [10, 10] and infos[-1]["_episode"].all()


@pytest.mark.parametrize("number", [math.nan, math.inf, 1e300])  # the last is finite in float64 alone
@pytest.mark.parametrize(("given", "at"), [("observation", 7), ("reward", 7), ("observation", 10)])
@pytest.mark.filterwarnings("error")
def test_a_number_that_is_not_finite_is_told_by_environment_and_step(own_infos, number, given, at):
    """In an observation, also the last of a game, and in a reward."""
    own_infos.kwargs |= {given: number, "at": at}
    envs = make_envs("OwnInfos-v0", 2)
    envs.reset(seed=[1, 2])
    with pytest.raises(EnvironmentFailed, match=f"{given} of environment 0 is not finite after {at} steps"):
        for _ in range(at):
            envs.step(np.array([0, 1]))
