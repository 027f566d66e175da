"""AC-PPO on Atari: PPO with an advantage-dependent clip range (thesis, section 3.1).

Theorem 3.1.1 bounds the error of PPO's surrogate by the product of ratio deviation and advantage, so the clip range
shrinks where the advantage is large: ε / (1 + c·|Â|) in place of ε. At c = 1 and ε = 0.16 it averages near PPO's 0.1.
What differs from ppo_atari.py is this text, the arguments clip_coef and c with its check, clip_range, and its call.
    python acppo_atari.py --env-id Breakout --c 1.0
    tensorboard --logdir runs

8 games at once, 5,000,000 agent steps = 20,000,000 emulator frames: hours on a CPU (the README has the speed and what
Breakout scores on the way). Scores, losses and how far each update moved the policy go to TensorBoard; the README
defines every curve. A stopped or killed run goes on with `--resume`. The two scripts are siblings: their diff is the
whole of AC-PPO, and a change to one is a change to both.

Sections: arguments, network, mathematics, run directory, training, command line.
"""

import contextlib
import ctypes
import fcntl
import importlib.metadata
import math
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections import deque
from dataclasses import dataclass, field, replace
from typing import NoReturn

if __name__ == "__main__":  # here alone: importing this file leaves the importer's process as it is
    # Idle OpenMP threads would spin on the cores that the games' threads need. torch reads this when it is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # glibc gives tensors of megabytes back to the system and faults their pages in again, 16 times an iteration:
    # keeping them takes the update from 2.1 to 1.7 s. -1 and -3 are M_TRIM_THRESHOLD and M_MMAP_THRESHOLD, in bytes.
    if hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-1, 1 << 30)
        libc.mallopt(-3, 1 << 30)

import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from torch import Tensor, nn
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from wrappers import env_seeds, make_envs


# ---------------------------------------------------------------------------------------------------- arguments
@dataclass
class Args:
    env_id: str = "Breakout"
    """the environment: an Atari game by its bare name (thesis protocol), `ALE/Breakout-v5` (the same with sticky
    actions), or a Gymnasium id with discrete actions such as `CartPole-v1`"""
    total_timesteps: int = 5_000_000
    """agent steps in all, over all environments; Atari shows 4 frames for each, so this is the thesis's 20M frames
    (chapter 4). Rounded down to whole rollouts"""
    learning_rate: float = 2.5e-4
    """Adam's step size at the start (appendix A)"""
    num_envs: int = 8
    """environments played at once, N (appendix A)"""
    num_steps: int = 128
    """agent steps of each environment in one rollout, T (appendix A)"""
    anneal_lr: bool = True
    """let the learning rate fall linearly to 0 over the run (appendix A)"""
    gamma: float = 0.99
    """discount rate per agent step, γ (appendix A)"""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimator (section 2.5, appendix A)"""
    num_minibatches: int = 4
    """minibatches that a rollout is cut into: N·T / 4 = 256 samples each (appendix A)"""
    update_epochs: int = 4
    """passes over each rollout (appendix A)"""
    norm_adv: bool = True
    """normalise the advantages of each minibatch (appendix B, line 28)"""
    clip_coef: float = 0.16
    """clip range of the probability ratio where the advantage is 0, ε (chapter 4); with `--c inf`, the bound δ on
    the product of ratio deviation and normalised advantage"""
    c: float = 1.0
    """weight of the advantage in the clip range ε / (1 + c·|Â|) (section 3.1): 0 is PPO, `inf` the range δ / |Â|, which
    is the thesis's product-only objective"""
    clip_vloss: bool = True
    """clip the value loss as CleanRL does; `--no-clip-vloss` is the plain squared error of appendix B"""
    vf_clip_coef: float = 0.1
    """how far a value may move in one update before its loss stops pulling, in units of return (CleanRL uses
    its clip range; here it is a coefficient of its own, so that ε never touches the value loss)"""
    ent_coef: float = 0.01
    """weight of the entropy bonus, c₂ (appendix A)"""
    vf_coef: float = 0.5
    """weight of the value loss, c₁ (CleanRL)"""
    max_grad_norm: float = 0.5
    """the gradient's norm is clipped to this (appendix A)"""
    target_kl: float | None = None
    """skip the remaining epochs once the mean of (ρ - 1) - log ρ over an epoch exceeds this, in nats (CleanRL,
    which looks at the last minibatch)"""
    seed: int = 1
    """seeds torch and, through one SeedSequence, every environment with a number of its own"""
    torch_deterministic: bool = True
    """have cuDNN choose deterministic algorithms (CleanRL); on a CPU, seed and thread count determine the run"""
    cuda: bool = True
    """use a GPU if there is one"""
    threads: int = field(default_factory=lambda: available_cores())
    """threads for torch and for the games, which take turns; the default is the cores this process may use"""
    bf16: bool = False
    """run the network's trunk in bfloat16 (ours): faster on processors with AVX512-BF16 or AMX, far slower on others;
    parameters, logits, values and losses stay float32"""
    compile: bool = False
    """compile the network with torch.compile (ours), which takes a C++ compiler and time at the start"""
    exp_name: str = os.path.basename(__file__).removesuffix(".py")
    """name of the experiment, part of the run's name"""
    log_dir: str = "runs"
    """directory that the run's own directory is made in"""
    checkpoint_minutes: float = 5.0
    """wall time between two checkpoints; 0 writes one after every iteration"""
    resume: str | None = None
    """directory of a run to go on with, under its own arguments; a flag given beside this one replaces the run's"""
    stop_at: int | None = None
    """agent steps at which this call ends, with a checkpoint; the schedule stays that of the whole run"""

    @property
    def batch_size(self) -> int:
        """Samples of one rollout, N·T."""
        return self.num_envs * self.num_steps

    @property
    def minibatch_size(self) -> int:
        return self.batch_size // self.num_minibatches

    @property
    def num_iterations(self) -> int:
        """Rollouts with their updates in the whole run."""
        return self.total_timesteps // self.batch_size

    def check(self) -> None:
        """Ends the program with status 2 at the first argument that cannot work."""

        def require(fits: bool, name: str, advice: str) -> None:
            if not fits:
                refuse(name, getattr(self, name), advice)

        for name in ("total_timesteps", "num_envs", "num_steps", "num_minibatches", "update_epochs"):
            require(getattr(self, name) > 0, name, "give a whole number above 0")
        for name in ("learning_rate", "clip_coef", "vf_clip_coef", "max_grad_norm"):  # 1e30: float32 must hold them
            require(0 < getattr(self, name) < 1e30, name, "give a finite number above 0")
        for name in ("ent_coef", "vf_coef", "checkpoint_minutes"):
            require(0 <= getattr(self, name) < 1e30, name, "give a finite number, 0 or above")
        require(0 <= self.c < 1e30 or self.c == math.inf, "c", "give a number, 0 or above, or inf")
        for name in ("gamma", "gae_lambda"):
            require(0 <= getattr(self, name) <= 1, name, "give a number from 0 to 1")
        for name in ("target_kl", "stop_at"):
            require(getattr(self, name) is None or getattr(self, name) > 0, name, "give a number above 0, or None")
        require(0 <= self.seed < 2**64, "seed", "give a whole number from 0 to 2^64 - 1")
        most_threads = 4 * available_cores()
        require(0 < self.threads <= most_threads, "threads", f"give a number from 1 to {most_threads}")
        names_a_directory = re.fullmatch(r"[\w.-]{1,100}", self.exp_name)
        require(names_a_directory, "exp_name", "it names a directory: give up to 100 of letters, digits, '.', '_', '-'")
        compiler = os.environ.get("CXX", "g++")
        require(not self.compile or shutil.which(compiler), "compile", f"there is no C++ compiler {compiler}")
        rollout = f"num_envs · num_steps = {self.batch_size}"
        require(
            self.batch_size <= 1_000_000, "num_steps", f"give a rollout of at most 1,000,000 samples, not {rollout}"
        )
        require(self.total_timesteps >= self.batch_size, "total_timesteps", f"give at least one rollout, {rollout}")
        require(self.batch_size % self.num_minibatches == 0, "num_minibatches", f"give a divisor of {rollout}")
        alone = self.norm_adv and self.minibatch_size == 1
        require(not alone, "num_minibatches", "one sample cannot be normalised: give fewer, or --no-norm-adv")


def available_cores() -> int:
    """Returns the number of cores this process may run on: its affinity, where the system has one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def refuse(name: str, given: object, advice: object) -> NoReturn:
    """Ends the program with status 2 and one line: the flag, what was given to it, and what to do."""
    print(" ".join(f"--{name.replace('_', '-')} {given}: {advice}".split()), file=sys.stderr)
    sys.exit(2)


# ------------------------------------------------------------------------------------------------------ network
class Agent(nn.Module):
    """Policy and value function: the Nature CNN shared by both for images, a small tanh MLP each for flat inputs."""

    def __init__(self, obs_shape: tuple[int, ...], num_actions: int, bf16: bool = False):
        super().__init__()
        self.bf16 = bf16
        if len(obs_shape) == 3:
            self.network = nn.Sequential(
                orthogonal(nn.Conv2d(obs_shape[0], 32, 8, stride=4)),
                nn.ReLU(inplace=True),
                orthogonal(nn.Conv2d(32, 64, 4, stride=2)),
                nn.ReLU(inplace=True),
                orthogonal(nn.Conv2d(64, 64, 3, stride=1)),
                nn.ReLU(inplace=True),
                nn.Flatten(),
                orthogonal(nn.Linear(64 * 7 * 7, 512)),
                nn.ReLU(inplace=True),
            )
            self.actor = orthogonal(nn.Linear(512, num_actions), gain=0.01)  # nearly uniform at the start
            self.critic = orthogonal(nn.Linear(512, 1), gain=1.0)
        else:
            self.network = nn.Identity()
            self.actor = tanh_mlp(obs_shape[0], num_actions, gain=0.01)
            self.critic = tanh_mlp(obs_shape[0], 1, gain=1.0)

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Maps observations, uint8 (B, 84, 84, 4) or float32 (B, D), to logits (B, A) and values (B,)."""
        # The view makes (B, 4, 84, 84) in channels-last layout, where an update takes 114 ms, 153 in torch's default.
        x = obs.movedim(-1, 1)
        if obs.dtype == torch.uint8:
            x = x.float().div_(255.0)  # 2.2 ms for a minibatch, x / 255 takes 3.2
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.bf16):  # the trunk alone: ratios need float32
            hidden = self.network(x).float()
        return self.actor(hidden), self.critic(hidden).squeeze(-1)


def orthogonal(layer: nn.Module, gain: float = math.sqrt(2)) -> nn.Module:
    """Initialises a layer as CleanRL and OpenAI's baselines do: orthogonal weights, zero biases."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


def tanh_mlp(num_inputs: int, num_outputs: int, gain: float) -> nn.Module:
    return nn.Sequential(
        orthogonal(nn.Linear(num_inputs, 64)),
        nn.Tanh(),
        orthogonal(nn.Linear(64, 64)),
        nn.Tanh(),
        orthogonal(nn.Linear(64, num_outputs), gain),
    )


@torch.inference_mode()
def act(agent: nn.Module, obs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Samples actions (B,) and returns them with the log-probabilities of all actions (B, A) and the values (B,)."""
    logits, values = agent(obs)
    logprobs = logits.log_softmax(-1)  # by hand: a validated Categorical takes 1.8 times as long
    return torch.multinomial(logprobs.exp(), 1).squeeze(-1), logprobs, values


@torch.inference_mode()
def value_of(agent: nn.Module, obs: Tensor) -> Tensor:
    """Returns the values (B,) of observations."""
    return agent(obs)[1]


# -------------------------------------------------------------------------------------------------- mathematics
def compute_gae(rewards, values, next_values, terminations, truncations, gamma: float, gae_lambda: float) -> Tensor:
    """Returns the generalised advantages (T, N) of a rollout: section 2.5, with the masks that appendix B lacks.

    Args, tensors (T, N): `rewards` of step t; `values` V(s_t); `next_values` V(s_t+1), where an episode was truncated
    V(the observation it ended on); `terminations` and `truncations`, bool, of step t. A termination means that nothing
    follows; a truncation only that nothing more was seen.
    """
    deltas = rewards + gamma * next_values * ~terminations - values  # δ_t
    carry = gamma * gae_lambda * ~(terminations | truncations)  # no advantage flows back out of the next episode
    advantages = torch.zeros_like(rewards)
    following = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        advantages[t] = following = deltas[t] + carry[t] * following
    return advantages


def normalize(advantages: Tensor) -> Tensor:
    """Shifts and scales to mean 0 and standard deviation 1 (appendix B, line 28)."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def clip_range(advantages: Tensor, clip_coef: float, c: float) -> Tensor:
    """Returns how far each sample's ratio may leave 1 (B,): ε / (1 + c·|Â|), no gradient (section 3.1).

    At c = inf it is δ / |Â| with δ = `clip_coef`, the limit for ε = c·δ: the thesis's product-only objective.
    """
    size = advantages.detach().abs()
    return clip_coef / size if math.isinf(c) else clip_coef / (1 + c * size)


def surrogate(ratio: Tensor, advantages: Tensor, clip: Tensor) -> Tensor:
    """Returns the clipped objective of each sample (B,), to be maximised: the term inside the expectation of (2.14)."""
    # The minimum is a lower bound: a clipped sample gains nothing, one that got worse still pulls back
    return torch.min(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)


def value_loss(new_values, values, returns, vf_clip_coef: float | None) -> Tensor:
    """Returns half the mean squared error of values (B,); of each and its clipped form the larger, unless None."""
    squared_error = (new_values - returns).square()
    if vf_clip_coef is not None:
        clipped = values + (new_values - values).clamp(-vf_clip_coef, vf_clip_coef)
        squared_error = torch.max(squared_error, (clipped - returns).square())
    return 0.5 * squared_error.mean()


def policy_change(logprobs, new_logprobs, actions, advantages) -> dict[str, Tensor]:
    """Measures how far an update moved the policy on the B states of its rollout (the README defines each name).

    Args: log-probabilities of all actions before and after (B, A), the actions taken (B,), the advantages as the
    objective saw them (B,). `kl` and the distances are exact over actions; the other three use the action taken, as
    the thesis's chapter 4 does.
    """
    logratio = (new_logprobs - logprobs).gather(1, actions[:, None]).squeeze(1)
    ratio = logratio.exp()
    tv_distance = 0.5 * (new_logprobs.exp() - logprobs.exp()).abs().sum(1)
    return {
        "kl": (logprobs.exp() * (logprobs - new_logprobs)).sum(1).mean(),
        "old_approx_kl": -logratio.mean(),
        "approx_kl": ((ratio - 1) - logratio).mean(),
        "tv_distance": tv_distance.mean(),
        "max_tv_distance": tv_distance.max(),
        "max_ratio_advantage": ((ratio - 1) * advantages).abs().max(),
    }


# ------------------------------------------------------------------------------------------------ run directory
def make_run_dir(args: Args) -> str:
    """Makes the run's own directory and returns its path; a name that is taken moves on to the next second."""
    os.makedirs(args.log_dir, exist_ok=True)
    started = int(time.time())
    while True:
        name = re.sub(r"[^\w.-]", "-", args.env_id)
        path = os.path.join(args.log_dir, f"{name}__{args.exp_name}__{args.seed}__{started}")
        try:
            os.mkdir(path)
            return path
        except FileExistsError:
            started += 1


class RunDirectory:
    """A run's event files and its checkpoint, held by one process at a time; a full disk costs points, not the run."""

    def __init__(self, path: str):
        """Opens an existing directory. Raises OSError; BlockingIOError where another process holds it."""
        self.path, self.checkpoint = path, os.path.join(path, "checkpoint.pt")
        self.lock = os.open(path, os.O_RDONLY)
        fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # dies with its process, unlike a lock file
        self.writer = None
        self.failed = False  # has anything not been written?
        self.waiting = False  # for the next checkpoint to succeed, before more is logged?

    def log(self, points: list[tuple], texts: list[tuple] = ()) -> None:
        """Writes (tag, value, agent step) to TensorBoard."""
        try:
            if not self.waiting:
                self.writer = self.writer or SummaryWriter(self.path)
                for text in texts:
                    self.writer.add_text(*text)
                for point in points:
                    self.writer.add_scalar(*point)
                self.writer.flush()
        except OSError as error:
            self.writer, self.waiting = None, True  # its thread has died of it; there is a successor after a checkpoint
            self.report(error)

    def save(self, state: dict) -> None:
        """Writes a checkpoint beside the last one and renames it over: at every instant one of the two is whole."""
        new = self.checkpoint + ".new"
        try:
            with open(new, "wb") as file:
                torch.save({**state, "event_files": self.event_files()}, file)
            for name in (new, *(os.path.join(self.path, name) for name in self.event_files())):
                with open(name, "rb+") as file:  # on the disk before the rename is, also if the power fails
                    os.fsync(file.fileno())
            os.replace(new, self.checkpoint)
            os.fsync(self.lock)
            self.waiting = False
        except (OSError, RuntimeError) as error:  # torch raises the latter where the file raised the former
            self.report(error)
            with contextlib.suppress(OSError):
                os.remove(new)  # half of it would fill the disk further

    def report(self, error: Exception) -> None:
        if not self.failed:
            say(f"{self.path}: {error}; training goes on, what cannot be written is lost")
        self.failed = True

    def load(self) -> dict:
        """Returns the checkpoint. Raises ValueError where there is none, or none that this script has written."""
        if not os.path.exists(self.checkpoint):
            raise ValueError("it holds no checkpoint; start the run anew")
        try:
            with zipfile.ZipFile(self.checkpoint) as archive:
                whole = archive.testzip() is None  # torch.load itself takes flipped bytes for parameters
            state = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
            args = state["args"]
            types = {name: type(value) for name, value in args.items() if value is not None}
            whole &= {type(state[name]) for name in ("iteration", "global_step", "starts")} == {int}
            whole &= {float} == {type(number) for number in (state["seconds"], *state["last_scores"])}
            whole &= state["global_step"] == state["iteration"] * args["num_envs"] * args["num_steps"]
        except Exception as error:  # whatever a file that is no checkpoint makes them raise
            raise ValueError("its checkpoint is damaged, or not a checkpoint") from error
        expected = {name: type(value) for name, value in saved_args(Args(target_kl=0.1)).items()}
        if not whole or args.keys() != expected.keys() or {**expected, **types} != expected:
            raise ValueError("its checkpoint is damaged, or of another script")
        return state

    def event_files(self) -> dict[str, int]:
        """Returns the size in bytes of each event file, by name."""
        return {file.name: file.stat().st_size for file in os.scandir(self.path) if file.name.startswith("events.")}

    def cut_back(self, event_files: dict[str, int]) -> None:
        """Takes out of the event files what was logged after the checkpoint, for every reader of them."""
        for name, size in self.event_files().items():
            os.truncate(os.path.join(self.path, name), min(size, event_files.get(name, 0)))


class StopSignal:
    """Notes the first SIGINT or SIGTERM in `number`, for a clean end; a second ends the process at once."""

    def __init__(self):
        self.number = 0
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self.note)

    def note(self, number: int, frame: object) -> None:
        self.number = number
        for again in (signal.SIGINT, signal.SIGTERM):
            signal.signal(again, signal.SIG_DFL)
        say("\nStopping after this iteration, with a checkpoint; once more ends at once")


def say(line: str) -> None:
    """Writes to standard error, whatever has become of it: the end of a pipe or a full disk must not end the run."""
    with contextlib.suppress(OSError):
        os.write(2, f"{line}\n".encode())


def saved_args(args: Args) -> dict[str, object]:
    """Returns the arguments that belong to the run, not to one call of it."""
    return {name: value for name, value in vars(args).items() if name not in ("resume", "stop_at")}


def provenance() -> dict[str, object]:
    """Returns what a reader needs to repeat a run besides its arguments: versions, commit, machine, threads."""
    packages = ["torch", "gymnasium", "ale-py", "numpy", "opencv-python-headless", "tensorboard", "tyro"]
    git = ["git", "-C", os.path.dirname(os.path.abspath(__file__)), "describe", "--always", "--dirty", "--abbrev=40"]
    git += ["--exclude=*"]  # no tags: the commit itself
    try:
        commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "not a git checkout"
    versions = {package: importlib.metadata.version(package) for package in packages}
    machine = f"{platform.platform()}, {available_cores()} cores, {torch.backends.cpu.get_cpu_capability()}"
    threads = f"{torch.get_num_threads()} torch, OMP_WAIT_POLICY {os.environ.get('OMP_WAIT_POLICY', 'not set')}"
    return {"commit": commit, "python": platform.python_version(), **versions, "machine": machine, "threads": threads}


def markdown_table(rows: dict[str, object]) -> str:
    return "\n".join(["|name|value|", "|-|-|", *(f"|{name}|{value}|" for name, value in rows.items())])


class Stopwatch:
    """Adds up the seconds spent in each phase of an iteration (a GPU's work counts where it is waited for)."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def lap(self, phase: str) -> None:
        """Counts the time since the last lap as `phase`."""
        now = time.perf_counter()
        self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self.last
        self.last = now


# ----------------------------------------------------------------------------------------------------- training
def train(
    args: Args, envs: VectorEnv, run: RunDirectory, state: dict | None = None, stop: StopSignal | None = None
) -> Agent:
    """Trains on `envs` as `args` say, from the checkpoint `state` where there is one; logs to `run`, returns the agent.

    Ends early at `args.stop_at` or when `stop` has noted a signal, and with status 1 at a number that is not finite.
    """
    # Setup
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.threads)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    num_actions = int(envs.single_action_space.n)
    agent = Agent(envs.single_observation_space.shape, num_actions, args.bf16)
    agent.to(device, memory_format=torch.channels_last)
    # eps as OpenAI's baselines have it, not torch's 1e-8; fused: 1.3 ms a step, not 5.7 (benchmark/tricks.py)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)

    # Where the run stands: at its beginning, or at its checkpoint with new games, for the emulators are not kept
    iteration, global_step, seconds_before = 0, 0, 0.0  # global_step: agent steps, over all environments
    starts = 0  # so far; each start draws environment seeds of its own
    last_scores = deque(maxlen=100)  # raw returns of whole games
    if state is not None:
        try:
            agent.load_state_dict(state["agent"])
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})
            iteration, global_step, seconds_before = state["iteration"], state["global_step"], state["seconds"]
            starts = state["starts"]
            last_scores.extend(state["last_scores"])
            torch.set_rng_state(state["rng"])
            if device.type == "cuda" and state["cuda_rng"]:
                torch.cuda.set_rng_state(state["cuda_rng"][0])
            run.cut_back(state["event_files"])
        except Exception as error:  # whatever a checkpoint that someone has written by hand makes them raise
            refuse("resume", run.path, f"its checkpoint does not fit this script ({type(error).__name__})")
    tables = {"hyperparameters": vars(args), "provenance": provenance()}
    run.log([], [(name, markdown_table(rows), global_step) for name, rows in tables.items()])

    def from_envs(array: np.ndarray) -> Tensor:
        """(N, 4, 84, 84) → (N, 84, 84, 4); flat observations stay as they are."""
        return torch.from_numpy(array).to(device).movedim(1, -1)

    # Storage: T steps of N environments. Row T of `obs` and `values` is where the rollout ends and the next begins.
    T, N = args.num_steps, args.num_envs
    next_obs, _ = envs.reset(seed=env_seeds(args.seed, N, starts))
    first_obs = from_envs(next_obs)
    obs = torch.zeros((T + 1, *first_obs.shape), dtype=first_obs.dtype, device=device)  # images stay uint8: 4x smaller
    values = torch.zeros((T + 1, N), device=device)
    logprobs = torch.zeros((T, N, num_actions), device=device)  # of all actions, so that the KL is exact over them
    actions = torch.zeros((T, N), dtype=torch.int64, device=device)
    rewards = torch.zeros((T, N), device=device)
    terminations = torch.zeros((T, N), dtype=torch.bool, device=device)
    truncations = torch.zeros((T, N), dtype=torch.bool, device=device)
    final_values = torch.zeros((T, N), device=device)  # V(final observation) where truncated; elsewhere stale
    obs[T] = first_obs

    # Executables: what runs the network in the loop, compiled or not, under one name
    policy = torch.compile(agent, dynamic=False) if args.compile else agent

    started = time.perf_counter()
    checkpoint_due = started  # at once, so that there is something to resume from at every moment
    iteration_ends = deque([started], maxlen=11)  # SPS is measured over the last 10 iterations
    progress = tqdm(
        initial=global_step,
        total=args.num_iterations * args.batch_size,
        disable=None,  # quiet where standard error is not a terminal
        bar_format="{percentage:3.0f}% |{bar}| step {n:,}/{total:,}, {remaining} left{postfix}",
    )

    while True:
        # Checkpoint: when due, and at the end
        finished = iteration >= args.num_iterations or global_step >= (args.stop_at or math.inf)
        if stop is not None and finished:
            stop.number = 0  # a signal now comes too late to stop anything
        finished = finished or (stop is not None and stop.number != 0)
        if finished or time.perf_counter() >= checkpoint_due:
            seconds = seconds_before + time.perf_counter() - started
            where = {"iteration": iteration, "global_step": global_step, "seconds": seconds, "starts": starts + 1}
            learnt = {"agent": agent.state_dict(), "optimizer": optimizer.state_dict()["state"]}
            cuda_rng = [torch.cuda.get_rng_state()] if device.type == "cuda" else []
            randomness = {"rng": torch.get_rng_state(), "cuda_rng": cuda_rng}
            scores = {"last_scores": list(last_scores)}
            run.save({"args": saved_args(args), **where, **learnt, **randomness, **scores})
            checkpoint_due = time.perf_counter() + 60 * args.checkpoint_minutes
        if finished:
            break

        iteration += 1
        stopwatch = Stopwatch()
        if args.anneal_lr:
            optimizer.param_groups[0]["lr"] = (1 - (iteration - 1) / args.num_iterations) * args.learning_rate

        # Rollout: T steps in N environments with the current policy
        obs[0] = obs[T]
        games = []  # (agent step, score, agent steps) of each game that ends
        for t in range(T):
            # Copied into the storage, because tensors made under inference_mode cannot enter a loss
            actions[t], logprobs[t], values[t] = act(policy, obs[t])
            stopwatch.lap("inference")
            next_obs, reward, terminated, truncated, infos = envs.step(actions[t].cpu().numpy())
            stopwatch.lap("environment")
            global_step += N
            obs[t + 1] = from_envs(next_obs)
            rewards[t] = torch.from_numpy(reward)
            terminations[t] = torch.from_numpy(terminated)
            truncations[t] = torch.from_numpy(truncated)
            if truncated.any():
                final_obs = np.stack(infos["final_obs"][truncated])  # the other rows are uninitialised memory
                final_values[t, truncations[t]] = value_of(agent, from_envs(final_obs))  # any batch size: not compiled
            if "episode" in infos:
                for n in np.flatnonzero(infos["_episode"]):
                    games.append((global_step, infos["episode"]["r"][n], infos["episode"]["l"][n]))
            stopwatch.lap("storage")

        # Advantages, and the TD(λ) returns that the values are fitted to
        values[T] = value_of(policy, obs[T])
        next_values = torch.where(truncations, final_values, values[1:])
        advantages = compute_gae(
            rewards, values[:T], next_values, terminations, truncations, args.gamma, args.gae_lambda
        )
        returns = advantages + values[:T]
        # (T, N, …) → (T·N, …)
        b_obs, b_values = obs[:T].flatten(0, 1), values[:T].flatten()
        b_logprobs, b_actions = logprobs.flatten(0, 1), actions.flatten()
        b_advantages, b_returns = advantages.flatten(), returns.flatten()
        stopwatch.lap("advantages")

        # Update: several epochs of minibatch gradient steps on the rollout
        minibatch_stats = []  # of tensors, read once an iteration: .item() in here would wait for the device
        for _ in range(args.update_epochs):
            for mb_inds in torch.randperm(args.batch_size, device=device).split(args.minibatch_size):
                # index_select copies whole screens: 0.2 ms where b_obs[mb_inds] takes 3.3 ms
                logits, new_values = policy(b_obs.index_select(0, mb_inds))
                new_logprobs = logits.log_softmax(-1)
                logratio = (new_logprobs - b_logprobs[mb_inds]).gather(1, b_actions[mb_inds, None]).squeeze(1)
                ratio = logratio.exp()  # ρ, 1 for all samples of the first minibatch
                mb_advantages = b_advantages[mb_inds]
                if args.norm_adv:
                    mb_advantages = normalize(mb_advantages)

                clip = clip_range(mb_advantages, args.clip_coef, args.c)
                pg_loss = -surrogate(ratio, mb_advantages, clip).mean()
                vf_clip_coef = args.vf_clip_coef if args.clip_vloss else None
                v_loss = value_loss(new_values, b_values[mb_inds], b_returns[mb_inds], vf_clip_coef)
                entropy = -(new_logprobs.exp() * new_logprobs).sum(-1).mean()
                loss = pg_loss + args.vf_coef * v_loss - args.ent_coef * entropy

                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()

                with torch.no_grad():
                    approx_kl = ((ratio - 1) - logratio).mean()
                    clipfrac = ((ratio - 1).abs() > clip).float().mean()  # each sample against its own range
                    avg_clip_ratio = clip.clamp(max=1).mean()  # a range above 1 cannot bind below; δ / 0 is infinite
                stats = (pg_loss, v_loss, entropy, clipfrac, avg_clip_ratio, approx_kl)
                minibatch_stats.append(torch.stack(stats).detach())
            if args.target_kl is not None:
                epoch_kl = torch.stack(minibatch_stats[-args.num_minibatches :])[:, -1].mean()
                if epoch_kl > args.target_kl:
                    break
        stopwatch.lap("update")

        # How far the policy moved, over the whole rollout (in minibatches, to bound the memory)
        with torch.inference_mode():
            new_logprobs = torch.cat([policy(chunk)[0].log_softmax(-1) for chunk in b_obs.split(args.minibatch_size)])
            seen_advantages = normalize(b_advantages) if args.norm_adv else b_advantages
            change = policy_change(b_logprobs, new_logprobs, b_actions, seen_advantages)
            variance = b_returns.var()  # 0 where all returns are equal, which leaves nothing to explain
            explained_variance = torch.where(variance > 0, 1 - (b_returns - b_values).var() / variance, math.nan)
        stopwatch.lap("kl_pass")

        # Log: once an iteration, the games at the steps where they ended
        points = []
        for step, score, length in games:
            last_scores.append(float(score))
            points += [("charts/episodic_return", score, step), ("charts/episodic_length", length, step)]
        if last_scores:
            points.append(("charts/mean_return_100", np.mean(last_scores), global_step))
        names = ("policy_loss", "value_loss", "entropy", "clipfrac", "avg_clip_ratio", "ratio")  # as in `stats`
        losses = dict(zip(names, torch.stack(minibatch_stats).mean(0).tolist(), strict=True))
        losses |= {name: value.item() for name, value in change.items()}
        broken = [name for name, value in losses.items() if not math.isfinite(value)]
        broken += [name for name, parameter in agent.named_parameters() if not parameter.isfinite().all()]
        if broken:  # before the checkpoint that would keep it
            sys.exit(f"{run.path}: not finite in iteration {iteration}, step {global_step}: {', '.join(broken)}")
        losses["explained_variance"] = explained_variance.item()  # may be NaN
        del losses["ratio"]  # its approx_kl, whose mean over minibatches is no curve of its own
        points += [(f"losses/{name}", value, global_step) for name, value in losses.items()]
        iteration_ends.append(time.perf_counter())
        sps = (len(iteration_ends) - 1) * args.batch_size / (iteration_ends[-1] - iteration_ends[0])
        points.append(("charts/learning_rate", optimizer.param_groups[0]["lr"], global_step))
        points.append(("charts/SPS", sps, global_step))
        run.log(points)
        stopwatch.lap("logging")
        run.log([(f"time/{phase}", seconds, global_step) for phase, seconds in stopwatch.seconds.items()])
        score = f", score {np.mean(last_scores):.1f}" if last_scores else ""
        progress.set_postfix_str(f"{sps:.0f} SPS{score}")
        progress.update(args.batch_size)

    progress.close()
    envs.close()
    return agent


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    # TensorBoard's thread prints a traceback when the disk is full; RunDirectory says it in one line
    threading.excepthook = lambda fault: issubclass(fault.exc_type, OSError) or threading.__excepthook__(fault)
    args, state, stop = tyro.cli(Args), None, StopSignal()
    if args.resume is not None:
        try:
            run = RunDirectory(args.resume)
            state = run.load()
        except BlockingIOError:
            refuse("resume", args.resume, "another process is training there; wait for its end")
        except (OSError, ValueError) as error:
            refuse("resume", args.resume, getattr(error, "strerror", None) or error)
        args = tyro.cli(Args, default=replace(Args(**state["args"]), resume=args.resume))
        for name in ("env_id", "num_envs", "num_steps", "seed", "exp_name", "log_dir"):
            if getattr(args, name) != state["args"][name]:
                refuse(name, getattr(args, name), f"the run has {state['args'][name]}, which cannot change")
    args.check()
    if state is not None and state["global_step"] >= min(
        args.num_iterations * args.batch_size, args.stop_at or math.inf
    ):
        limit = "--total-timesteps" if state["iteration"] >= args.num_iterations else "--stop-at"
        print(f"{args.resume} is finished up to {limit}, at step {state['global_step']}; a larger one takes it further")
        return
    try:
        envs = make_envs(args.env_id, args.num_envs, num_threads=args.threads)
    except ValueError as error:
        refuse("env_id", args.env_id, error)
    if state is None:
        try:
            run = RunDirectory(make_run_dir(args))  # last, so that nothing refused above leaves one behind
        except OSError as error:
            refuse("log_dir", args.log_dir, f"cannot be written ({error.strerror}); give another directory")
    train(args, envs, run, state, stop)
    if run.failed:
        sys.exit(1)
    if stop.number:
        say(f"Stopped; go on with: {shlex.join([sys.executable, __file__, '--resume', run.path])}")
        sys.exit(128 + stop.number)


if __name__ == "__main__":
    main()
