"""The environments of both scripts: Atari, or any Gymnasium environment with discrete actions, as a vector environment.

    envs = make_envs("Breakout", num_envs=8)
    next_obs, _ = envs.reset(seed=env_seeds(seed=1, num_envs=8))

Atari runs in ale-py's C++ threads under Gymnasium's own vector wrappers; `EpisodicLife` is the one behaviour that
neither has. Whatever else is registered with Gymnasium runs in a `SyncVectorEnv`. Both reset in the step that ends a
game (`SAME_STEP`): with Gymnasium's default, `NEXT_STEP`, every game would be followed by a dummy transition that
PPO then trains on.
"""

import difflib
import importlib.metadata
import os
import re
import sys
import warnings
from collections.abc import Callable, Sequence

import ale_py
import gymnasium as gym
import numpy as np
from ale_py.vector_env import AtariVectorEnv
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple, flatdim
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from gymnasium.wrappers import (
    FlattenObservation,
    FrameStackObservation,
    GrayscaleObservation,
    ReshapeObservation,
    ResizeObservation,
    TransformAction,
    TransformObservation,
)
from gymnasium.wrappers.vector import RecordEpisodeStatistics, TransformReward

gym.register_envs(ale_py)

FRAME_SKIP = 4  # emulator frames shown for each agent step
SCREEN = (84, 84)  # height and width of an observation, pixels
STACK = 4  # most recent screens in an observation
SMALLEST_SCREEN = 36  # height and width from which on uint8 observations are screens: the least that the CNN takes


# ------------------------------------------------------------------------------------------------- environments
def make_envs(
    env_id: str, num_envs: int, num_threads: int = 0, max_frames: int = 108_000, video: str | None = None
) -> VectorEnv:
    """Builds N = `num_envs` copies of an environment, stepped together, each reset in the step that ends its game.

    Args:
        env_id: an Atari game (`Breakout`, `breakout`, `BreakoutNoFrameskip-v4`: the thesis's protocol, without sticky
            actions; `ALE/Breakout-v5`: the same with its registered sticky actions), or any other registered
            Gymnasium id, `module:Env-v0` included: the module may lie in the current directory.
        num_threads: threads that step Atari games; 0 leaves the number to ale-py. Other environments use one.
        max_frames: emulator frames after which an Atari game is truncated, counted from the end of its no-ops.
        video: an MP4 file that the first game of the first environment is written to, from each `reset` on.

    Returns:
        A vector environment in `SAME_STEP` autoreset. Observations: uint8 (N, 4, 84, 84) for Atari and other screens,
        float32 (N, D) for all others. Rewards: float32 signs for Atari, as they are elsewhere.
        After a step in which games have ended, and no other, `info["_episode"]` (N,) is true for those and
        `info["episode"]` holds their raw, unclipped scores `"r"` and lengths `"l"` in agent steps; if one was
        truncated, `info["final_obs"]` holds the observation that it ended on (other rows are not to be read).

    Raises ValueError if the environment is unknown, cannot be built or rendered, or has spaces that are not supported;
    OSError if the game's ROM is missing or another one.
    """
    if (atari := find_atari_game(env_id)) is None:
        return make_gymnasium_envs(env_id, num_envs, video)
    rom, repeat_action_probability = atari
    options = {
        "num_threads": num_threads,
        "max_num_frames_per_episode": max_frames,
        "repeat_action_probability": repeat_action_probability,
        "frameskip": FRAME_SKIP,
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "maxpool": True,  # over the last two frames: sprites flicker
        "noop_max": 30,  # 0 to 29 of them
        "full_action_space": False,
        "episodic_life": False,  # would reset the whole game at a lost life: later lives are never seen
        "life_loss_info": False,  # would report it, but as the end of a game to the statistics below as well
        "reward_clipping": False,  # would hide the score
        "use_fire_reset": False,  # would press FIRE before the no-ops, and never after a lost life
    }
    envs = AtariVectorEnv(rom, num_envs, img_height=SCREEN[0], img_width=SCREEN[1], stack_num=STACK, **options)
    if video is not None:  # at the bottom, to see the actions that the games get
        in_colour = {"grayscale": False, "img_height": 210, "img_width": 160, "stack_num": 1}
        twin = AtariVectorEnv(rom, num_envs, **in_colour, **options)  # same seeds, same actions: the same games
        envs = RecordVideo(envs, video, 60 / FRAME_SKIP, twin)
    envs = RecordEpisodeStatistics(envs)  # above EpisodicLife it would count lives, above the sign clipped rewards
    envs = EpisodicLife(envs)
    return TransformReward(envs, lambda rewards: np.sign(rewards).astype(np.float32))


def env_seeds(seed: int | list[int], num_envs: int, starts: int = 0) -> list[int]:
    """Returns a seed for each environment, drawn from one `SeedSequence`: runs with neighbouring seeds share none.

    A run that has been started `starts` times before gets the next numbers of its sequence, for new games; games
    played beside the training have sequences of their own, `[seed, 1]` for evaluations and `[seed, 2]` for videos.
    Gymnasium's own rule, seed, seed + 1, …, gives run 2 seven of the eight environments of run 1. 31 bits, because
    ale-py refuses larger ones.
    """
    numbers = np.random.SeedSequence(seed).generate_state(num_envs * (starts + 1)) >> 1
    return [int(number) for number in numbers[-num_envs:]]


class EnvironmentFailed(Exception):
    """Whatever came out of an environment that is a program of somebody else's, `sys.exit()` included."""


class Guarded(VectorWrapper):
    """Raises EnvironmentFailed for any error in a reset or a step; one in `close` is only reported."""

    def reset(self, **given):
        return self.guard(self.env.reset, **given)

    def step(self, actions: np.ndarray):
        return self.guard(self.env.step, actions)

    def guard(self, method: Callable, *given, **named):
        try:
            return method(*given, **named)
        except (Exception, SystemExit) as error:
            raise EnvironmentFailed(f"{type(error).__name__}: {error}") from error

    def close(self, **kwargs):
        try:
            self.guard(self.env.close, **kwargs)
        except EnvironmentFailed as error:
            print(f"The environment could not be closed ({error})", file=sys.stderr)


class WithoutInfo(gym.Wrapper):
    """Drops an environment's own infos: keys such as `episode` or `final_obs` would be taken for the wrappers' here."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:  # for environments that draw from their spaces
            self.unwrapped.action_space.seed(seed)
            self.unwrapped.observation_space.seed(seed)
        return self.env.reset(seed=seed, options=options)[0], {}

    def step(self, action):
        obs, reward, terminated, truncated, _ = self.env.step(action)
        return obs, reward, terminated, truncated, {}


class FiniteNumbers(VectorWrapper):
    """Raises FloatingPointError at an observation or a reward that is not finite in float32: nothing learns from it."""

    def reset(self, **given):
        obs, infos = self.env.reset(**given)
        self.num_steps = 0
        self.check("observation", obs)
        return obs, infos

    def step(self, actions: np.ndarray):
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        self.num_steps += 1
        self.check("observation", obs)
        self.check("reward", to_float32(rewards))
        for number in np.flatnonzero(infos.get("_final_obs", False)):
            self.check("last observation", infos["final_obs"][number][None], number)
        return obs, rewards, terminations, truncations, infos

    def check(self, what: str, numbers: np.ndarray, first: int = 0) -> None:
        """Checks an array that has an environment in each row, from environment `first` on."""
        if numbers.dtype == np.uint8:  # screens
            return
        if not (finite := np.isfinite(numbers).reshape(len(numbers), -1).all(axis=1)).all():
            number = first + np.flatnonzero(~finite)[0]
            raise FloatingPointError(f"the {what} of environment {number} is not finite after {self.num_steps} steps")


class RecordVideo(VectorWrapper):
    """Writes the first game of the first environment to an MP4 file (VP9): in colour, without sound, in real time.

    Shows the screens of `twin`, games in lockstep with the agent's, or the environments' own renders. The last screen
    of a game is there only with a twin: others have already been reset when they can be asked.
    """

    def __init__(self, envs: VectorEnv, path: str, fps: float, twin: VectorEnv | None = None):
        super().__init__(envs)
        self.path, self.fps, self.twin, self.video = path, fps, twin, None

    def reset(self, *, seed=None, options=None):
        """Begins the file anew. Raises OSError if it cannot be written."""
        obs, infos = self.env.reset(seed=seed, options=options)
        screen = self.env.render()[0] if self.twin is None else self.twin.reset(seed=seed, options=options)[0][0, 0]
        import cv2  # here, because it changes the environment variables of whoever imports it

        vp9 = cv2.VideoWriter_fourcc(*"vp09")
        self.video = cv2.VideoWriter(self.path, cv2.CAP_FFMPEG, vp9, self.fps, screen.shape[1::-1])
        if not self.video.isOpened():
            raise OSError(f"OpenCV cannot write {self.path}")
        self.write(screen)
        return obs, infos

    def step(self, actions: np.ndarray):
        result = self.env.step(actions)
        game_over = result[2][0] or result[3][0]
        if self.twin is not None:
            obs, *_, infos = self.twin.step(actions)
            self.write((infos["final_obs"] if game_over else obs)[0, 0])
        elif not game_over:
            self.write(self.env.render()[0])
        if game_over:
            self.finish()
        return result

    def write(self, screen: np.ndarray) -> None:
        if self.video is not None:
            self.video.write(np.ascontiguousarray(screen[..., ::-1]))  # OpenCV takes blue first

    def finish(self) -> None:
        if self.video is not None:
            self.video.release()
            self.video = None

    def close(self, **kwargs):
        self.finish()
        super().close(**kwargs)


class EpisodicLife(VectorWrapper):
    """Reports a lost life as a termination while the game goes on, and presses FIRE when a life starts.

    A lost life is the fall of `info["lives"]` to a number above 0, as CleanRL and Stable-Baselines3 count it: the last
    one ends the game itself. Frogger and BankHeist show 0 during the last life, so its start is not reported. Games
    without lives (Pong, DoubleDunk) always show 0. No reset follows, so the next observation is the same game's.

    FIRE replaces the first action of each game and each life, in games that have FIRE: Breakout would stand still
    until the time limit without it. For the learner, that is an environment whose first action has no effect.
    """

    def __init__(self, envs: VectorEnv):
        super().__init__(envs)
        action_set = envs.unwrapped.ale.get_action_set()
        self.fire = action_set.index(ale_py.Action.FIRE) if ale_py.Action.FIRE in action_set else None

    def reset(self, *, seed: Sequence[int] | int | None = None, options: dict | None = None):
        # ale-py takes an int or an array, Gymnasium's SyncVectorEnv an int or a list
        obs, infos = self.env.reset(seed=np.array(seed) if isinstance(seed, Sequence) else seed, options=options)
        self.lives = infos["lives"]
        self.life_starts = np.ones(self.num_envs, dtype=bool)
        return obs, infos

    def step(self, actions: np.ndarray):
        if self.fire is not None:
            actions = np.where(self.life_starts, self.fire, actions)
        obs, rewards, terminations, truncations, infos = self.env.step(actions)
        game_over = terminations | truncations
        # Where the game is over, `lives` already belongs to the next one
        life_lost = (infos["lives"] < self.lives) & (infos["lives"] > 0) & ~game_over
        self.lives = infos["lives"]
        self.life_starts = game_over | life_lost
        return obs, rewards, terminations | life_lost, truncations, infos


def find_atari_game(env_id: str) -> tuple[str, float] | None:
    """Returns the ROM's name and the probability of sticky actions, or None if `env_id` is not an Atari name.

    Raises ValueError for an Atari name that cannot be played under the protocol of `make_envs`.
    """
    env_id = env_id.removeprefix("ale_py:")  # as elsewhere, where it has Gymnasium import ale-py
    registered = gym.registry.get(env_id.rpartition(":")[2])
    if registered is not None and registered.entry_point != "ale_py.env:AtariEnv":
        return None  # Gymnasium's Blackjack-v1 is not Atari's Blackjack
    if registered is not None and registered.namespace == "ALE":
        return registered.kwargs["game"], registered.kwargs["repeat_action_probability"]

    name, variant = re.fullmatch(r"(.*?)((?:NoFrameskip|Deterministic|-ram)*(?:-v\d+)?)", env_id, re.DOTALL).groups()
    key = name.removeprefix("ALE/").replace("_", "").lower()
    two_player = {rom.replace("_", "") for rom in ale_py.roms.get_all_rom_ids()} - atari_specs().keys()
    if key in two_player:
        raise ValueError("the game has no mode for one player; choose another")
    if key not in atari_specs():
        return None
    spec = atari_specs()[key]
    if name.startswith("ALE/") or variant not in ("", "NoFrameskip-v4"):
        raise ValueError(f"not an id of this project's protocol; use {spec.name}, or {spec.id} for sticky actions")
    return spec.kwargs["game"], 0.0


def canonical_name(env_id: str) -> str:
    """Returns a game's name as ale-py spells it (`pong` and `PongNoFrameskip-v4` are `Pong`); other ids stay."""
    rom, repeat_action_probability = find_atari_game(env_id) or ("", None)
    return atari_specs()[rom.replace("_", "")].name if repeat_action_probability == 0 else env_id


def atari_specs() -> dict[str, EnvSpec]:
    """Returns the games that ale-py registers (`ALE/…-v5`), keyed by name in lower case without underscores.

    Four of its ROMs are for two players and are not registered; `AtariVectorEnv` kills the process on those.
    """
    return {spec.name.lower(): spec for spec in gym.registry.values() if spec.namespace == "ALE"}


def make_gymnasium_envs(env_id: str, num_envs: int, video: str | None = None) -> VectorEnv:
    """Builds `make_envs`'s vector environment for an id that is not Atari. Raises ValueError as `make_envs` does."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # "out of date": the id was chosen, or is refused below in one line
            import_registrations(env_id)
            envs = gym.make_vec(
                env_id,
                num_envs,
                vectorization_mode="sync",
                vector_kwargs={"autoreset_mode": AutoresetMode.SAME_STEP},
                wrappers=[preprocess],
                **({} if video is None else {"render_mode": "rgb_array"}),
            )
            envs.reset()  # an environment that cannot start, or has another interface, is refused here, too
            envs.step(np.zeros(num_envs, np.int64))
            screen = None if video is None else envs.render()[0]
    except gym.error.UnregisteredEnv as error:
        close = difflib.get_close_matches(env_id.lower(), atari_specs(), n=1)
        raise ValueError(f"did you mean {atari_specs()[close[0]].name}?" if close else error) from error
    except (Exception, SystemExit) as error:  # whatever a foreign module or constructor raises
        verb = "built" if video is None else "rendered"
        advice = "; rename yours, this project has one" if re.search("(from|module) 'wrappers'", str(error)) else ""
        raise ValueError(f"it cannot be {verb}: {error or type(error).__name__}{advice}") from error
    if video is not None:
        if not (isinstance(screen, np.ndarray) and screen.dtype == np.uint8 and screen.shape[2:] == (3,)):
            raise ValueError("no video can be made of it: its render is not an array (height, width, 3) of uint8")
        envs = RecordVideo(envs, video, float(envs.metadata.get("render_fps") or 30))
    return Guarded(RecordEpisodeStatistics(FiniteNumbers(envs)))


def import_registrations(env_id: str) -> None:
    """Lets an id's module lie in the current directory, and calls what packages declare to register environments."""
    if ":" in env_id and os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # last, so that nothing in it hides a package
    module, _, name = env_id.rpartition(":")
    for call in importlib.metadata.entry_points(group="gymnasium.envs"):  # which Gymnasium made until 1.0
        declared = call.module.split(".")[0] == module or call.name == name.rpartition("/")[0]
        if declared and name not in gym.registry:
            call.load()()


def preprocess(env: gym.Env) -> gym.Env:
    """Turns screens into stacked grey ones, uint8 (4, 84, 84), and all other observations into float32 (D,).

    Raises ValueError for observations with a part that is no array of numbers, and for other than `Discrete` actions.
    """
    obs_space, action_space = env.observation_space, env.action_space
    if not isinstance(action_space, Discrete):
        raise ValueError(f"its actions are {action_space}; only Discrete actions are supported")
    env = WithoutInfo(env)
    start, dtype = int(action_space.start), action_space.dtype  # the scripts count actions from 0, in int64
    env = TransformAction(env, lambda action: dtype.type(action + start), Discrete(int(action_space.n)))

    shape = obs_space.shape if isinstance(obs_space, Box) and obs_space.dtype == np.uint8 else ()
    is_image = len(shape) == 2 or (len(shape) == 3 and shape[-1] in (1, 3))
    if not is_image or min(shape[:2]) < SMALLEST_SCREEN:  # the small ones are grids of symbols, such as MiniGrid's
        if not is_numeric(obs_space) or flatdim(obs_space) == 0:
            raise ValueError(f"its observations are {obs_space}, not numbers; a wrapper can leave the rest out")
        flat = Box(-np.inf, np.inf, (flatdim(obs_space),), np.float32)
        return TransformObservation(FlattenObservation(env), to_float32, flat)
    if len(shape) == 3:
        env = GrayscaleObservation(env) if shape[-1] == 3 else ReshapeObservation(env, shape[:2])
    env = ResizeObservation(env, SCREEN)  # before the stack: one screen is resized, not four
    return FrameStackObservation(env, STACK)


def to_float32(numbers: np.ndarray) -> np.ndarray:
    """Rounds to float32; numbers beyond it become infinite, and are refused by `FiniteNumbers`."""
    with np.errstate(over="ignore"):
        return np.asarray(numbers, np.float32)


def is_numeric(space: Space) -> bool:
    """Says whether all parts of a space are arrays of numbers: of text, Gymnasium would make character codes."""
    if isinstance(space, Dict | Tuple):
        return all(map(is_numeric, space.values() if isinstance(space, Dict) else space))
    return isinstance(space, Box | Discrete | MultiBinary | MultiDiscrete)
