"""PPO on Atari: the baseline of the thesis (sections 2.4 to 2.6, hyperparameters of appendix A).

The clipped surrogate (2.14), generalised advantages (2.5), a clipped value loss and an entropy bonus.
    python ppo_atari.py --env-id Breakout
    tensorboard --logdir runs

8 games at once, 5,000,000 agent steps = 20,000,000 emulator frames. Scores, losses and how far each update moved the
policy go to TensorBoard; the README defines every curve. Expect 3 to 4 hours on two cores with AVX-512, twice that
without; on Breakout a score above 8 after the first 300,000 steps. The two scripts are siblings: their diff is the
whole of AC-PPO, and a change to one is a change to both.

Sections: arguments, network, mathematics, run directory, training, command line.
"""

import importlib.metadata
import math
import os
import platform
import re
import shutil
import subprocess
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from typing import NoReturn

if __name__ == "__main__":
    # Idle OpenMP threads would spin on the cores that the games' threads need. torch reads this when it is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from torch import nn
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
    clip_coef: float = 0.1
    """clip range of the probability ratio, ε (2.14, appendix A)"""
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
    """skip the remaining epochs once the mean of (ρ - 1) - log ρ over an epoch exceeds this, in nats (CleanRL)"""
    seed: int = 1
    """seeds torch and, through one SeedSequence, every environment with a number of its own"""
    torch_deterministic: bool = True
    """have cuDNN choose deterministic algorithms (CleanRL); without a GPU the same seed gives the same run anyway"""
    cuda: bool = True
    """use a GPU if there is one"""
    threads: int = field(default_factory=lambda: available_cores())
    """threads for torch and for the games, which take turns; the default is the cores this process may use"""
    bf16: bool = False
    """run the network's trunk in bfloat16 (ours): worth it on processors with AVX512-BF16 or AMX and on GPUs, ten times
    slower on others; parameters, logits, values and losses stay float32"""
    compile: bool = False
    """compile the network with torch.compile (ours), which takes a C++ compiler and a minute at the start"""
    exp_name: str = os.path.basename(__file__).removesuffix(".py")
    """name of the experiment, part of the run's name"""
    log_dir: str = "runs"
    """directory that the run's own directory is made in"""

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
        positive = "total_timesteps num_envs num_steps num_minibatches update_epochs threads".split()
        positive += "learning_rate clip_coef vf_clip_coef max_grad_norm".split()
        for name in positive:
            if not 0 < getattr(self, name) < math.inf:
                refuse(name, getattr(self, name), "give a finite number above 0")
        for name in ("ent_coef", "vf_coef"):
            if not 0 <= getattr(self, name) < math.inf:
                refuse(name, getattr(self, name), "give a finite number, 0 or above")
        for name in ("gamma", "gae_lambda"):
            if not 0 <= getattr(self, name) <= 1:
                refuse(name, getattr(self, name), "give a number from 0 to 1")
        if self.target_kl is not None and not self.target_kl > 0:
            refuse("target_kl", self.target_kl, "give a number above 0, or None for no limit")
        if not 0 <= self.seed < 2**64:
            refuse("seed", self.seed, "give a whole number from 0 to 2^64 - 1")
        if not re.fullmatch(r"[\w.-]+", self.exp_name):
            refuse("exp_name", self.exp_name, "give letters, digits, '.', '_' and '-' only: it names a directory")
        if self.compile and not shutil.which(compiler := os.environ.get("CXX", "g++")):
            refuse("compile", self.compile, f"there is no C++ compiler {compiler}; install one or leave --compile out")
        if self.total_timesteps < self.batch_size:
            advice = f"give at least one rollout, num_envs · num_steps = {self.batch_size}"
            refuse("total_timesteps", self.total_timesteps, advice)
        if self.batch_size % self.num_minibatches != 0:
            advice = f"give a divisor of a rollout's {self.batch_size} samples (num_envs · num_steps)"
            refuse("num_minibatches", self.num_minibatches, advice)
        if self.norm_adv and self.minibatch_size == 1:
            advice = "one sample cannot be normalised: give fewer minibatches, or --no-norm-adv"
            refuse("num_minibatches", self.num_minibatches, advice)


def available_cores() -> int:
    """Returns the number of cores this process may run on, which a container can make fewer than the machine's."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()


def refuse(name: str, given: object, advice: object) -> NoReturn:
    """Ends the program with status 2 and one line: the flag, what was given to it, and what to do."""
    print(f"--{name.replace('_', '-')} {given}: {advice}", file=sys.stderr)
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

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Maps observations, uint8 (B, 84, 84, 4) or float32 (B, D), to logits (B, A) and values (B,)."""
        # The view makes (B, 4, 84, 84) in channels-last layout, in which the convolutions are fastest.
        x = obs.movedim(-1, 1)
        if obs.dtype == torch.uint8:
            x = x.float().div_(255.0)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.bf16):
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
def act(agent: nn.Module, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Samples actions (B,) and returns them with the log-probabilities of all actions (B, A) and the values (B,)."""
    logits, values = agent(obs)
    logprobs = logits.log_softmax(-1)
    return torch.multinomial(logprobs.exp(), 1).squeeze(-1), logprobs, values


@torch.inference_mode()
def value_of(agent: nn.Module, obs: torch.Tensor) -> torch.Tensor:
    """Returns the values (B,) of observations."""
    return agent(obs)[1]


# -------------------------------------------------------------------------------------------------- mathematics
def compute_gae(
    rewards: torch.Tensor,
    values: torch.Tensor,
    next_values: torch.Tensor,
    terminations: torch.Tensor,
    truncations: torch.Tensor,
    gamma: float,
    gae_lambda: float,
) -> torch.Tensor:
    """Returns the generalised advantages (T, N) of a rollout: section 2.5, with the masks that appendix B leaves out.

    Args, all (T, N): `rewards` of step t; `values` V(s_t); `next_values` V(s_t+1), where an episode was truncated the
    value of the observation it ended on; `terminations` and `truncations`, bool, of step t. A termination means that
    nothing follows; a truncation only that nothing more was seen.
    """
    deltas = rewards + gamma * next_values * ~terminations - values
    carry = gamma * gae_lambda * ~(terminations | truncations)
    advantages = torch.zeros_like(rewards)
    following = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        advantages[t] = following = deltas[t] + carry[t] * following
    return advantages


def normalize(advantages: torch.Tensor) -> torch.Tensor:
    """Shifts and scales to mean 0 and standard deviation 1 (appendix B, line 28)."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def clip_range(advantages: torch.Tensor, clip_coef: float) -> torch.Tensor:
    """Returns how far each sample's ratio may leave 1 (B,): ε, whatever the advantage (2.14)."""
    return torch.full_like(advantages, clip_coef)


def surrogate(ratio: torch.Tensor, advantages: torch.Tensor, clip: torch.Tensor) -> torch.Tensor:
    """Returns the clipped objective of each sample (B,), to be maximised: the term inside the expectation of (2.14)."""
    return torch.min(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)


def value_loss(
    new_values: torch.Tensor, values: torch.Tensor, returns: torch.Tensor, vf_clip_coef: float | None
) -> torch.Tensor:
    """Returns half the mean squared error; with `vf_clip_coef`, the larger of it and that of the clipped value."""
    squared_error = (new_values - returns).square()
    if vf_clip_coef is not None:
        clipped = values + (new_values - values).clamp(-vf_clip_coef, vf_clip_coef)
        squared_error = torch.max(squared_error, (clipped - returns).square())
    return 0.5 * squared_error.mean()


def policy_change(
    logprobs: torch.Tensor, new_logprobs: torch.Tensor, actions: torch.Tensor, advantages: torch.Tensor
) -> dict[str, torch.Tensor]:
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


def provenance() -> dict[str, object]:
    """Returns what a reader needs to repeat a run besides its arguments: versions, commit, machine, threads."""
    packages = "torch gymnasium ale-py numpy opencv-python-headless tensorboard tyro".split()
    git = ["git", "-C", os.path.dirname(os.path.abspath(__file__)), "describe", "--always", "--dirty", "--abbrev=40"]
    try:
        commit = subprocess.run(git, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "not a git checkout"
    return {
        "commit": commit,
        "python": platform.python_version(),
        **{package: importlib.metadata.version(package) for package in packages},
        "machine": platform.platform(),
        "cpu capability": torch.backends.cpu.get_cpu_capability(),
        "cores available": available_cores(),
        "torch threads": torch.get_num_threads(),
        "torch interop threads": torch.get_num_interop_threads(),
        "OMP_WAIT_POLICY": os.environ.get("OMP_WAIT_POLICY", "not set"),
    }


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
def train(args: Args, envs: VectorEnv, run_dir: str) -> Agent:
    """Trains on `envs` as `args` say, logs to `run_dir`, and returns the agent."""
    # Setup
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.threads)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    writer = SummaryWriter(run_dir)
    writer.add_text("hyperparameters", markdown_table(vars(args)))
    writer.add_text("provenance", markdown_table(provenance()))
    num_actions = int(envs.single_action_space.n)
    agent = Agent(envs.single_observation_space.shape, num_actions, args.bf16)
    agent.to(device, memory_format=torch.channels_last)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)

    # Executables: what runs the network in the loop, compiled or not
    policy = torch.compile(agent, dynamic=False) if args.compile else agent

    def from_envs(array: np.ndarray) -> torch.Tensor:
        """(N, 4, 84, 84) → (N, 84, 84, 4); flat observations stay as they are."""
        return torch.from_numpy(array).to(device).movedim(1, -1)

    # Storage: T steps of N environments. Row T of `obs` and `values` is where the rollout ends and the next begins.
    T, N = args.num_steps, args.num_envs
    next_obs, _ = envs.reset(seed=env_seeds(args.seed, N))
    first_obs = from_envs(next_obs)
    obs = torch.zeros((T + 1, *first_obs.shape), dtype=first_obs.dtype, device=device)  # images stay uint8: 4x smaller
    values = torch.zeros((T + 1, N), device=device)
    logprobs = torch.zeros((T, N, num_actions), device=device)  # of all actions, so that the KL is exact over them
    actions = torch.zeros((T, N), dtype=torch.int64, device=device)
    rewards = torch.zeros((T, N), device=device)
    terminations = torch.zeros((T, N), dtype=torch.bool, device=device)
    truncations = torch.zeros((T, N), dtype=torch.bool, device=device)
    final_values = torch.zeros((T, N), device=device)  # V(the observation a truncated game ended on), 0 elsewhere
    obs[T] = first_obs

    global_step = 0  # agent steps, over all environments
    last_scores = deque(maxlen=100)  # raw returns of whole games
    iteration_ends = deque([time.perf_counter()], maxlen=11)  # SPS is measured over the last 10 iterations
    progress = tqdm(
        total=args.num_iterations * args.batch_size,
        disable=None,  # quiet where standard error is not a terminal
        bar_format="{percentage:3.0f}% |{bar}| step {n:,}/{total:,}, {remaining} left{postfix}",
    )

    for iteration in range(1, args.num_iterations + 1):
        stopwatch = Stopwatch()
        if args.anneal_lr:
            optimizer.param_groups[0]["lr"] = (1 - (iteration - 1) / args.num_iterations) * args.learning_rate

        # Rollout: T steps in N environments with the current policy
        obs[0] = obs[T]
        games = []  # (agent step, score, agent steps) of each game that ends
        for t in range(T):
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
                final_values[t, truncations[t]] = value_of(agent, from_envs(final_obs))
            if "episode" in infos:
                for n in np.flatnonzero(infos["_episode"]):
                    games.append((global_step, infos["episode"]["r"][n], infos["episode"]["l"][n]))
            stopwatch.lap("storage")

        # Advantages, and the TD(λ) returns that the values are fitted to
        values[T] = value_of(agent, obs[T])
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
        minibatch_stats = []  # tensors: reading one here would wait for the device
        for _ in range(args.update_epochs):
            for mb_inds in torch.randperm(args.batch_size, device=device).split(args.minibatch_size):
                # index_select copies whole screens: 0.3 ms where b_obs[mb_inds] takes 4.5 ms
                logits, new_values = policy(b_obs.index_select(0, mb_inds))
                new_logprobs = logits.log_softmax(-1)
                logratio = (new_logprobs - b_logprobs[mb_inds]).gather(1, b_actions[mb_inds, None]).squeeze(1)
                ratio = logratio.exp()
                mb_advantages = b_advantages[mb_inds]
                if args.norm_adv:
                    mb_advantages = normalize(mb_advantages)

                clip = clip_range(mb_advantages, args.clip_coef)
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
                    clipfrac = ((ratio - 1).abs() > clip).float().mean()
                    avg_clip_ratio = clip.clamp(max=1).mean()
                    minibatch_stats.append(torch.stack([pg_loss, v_loss, entropy, clipfrac, avg_clip_ratio, approx_kl]))
            if args.target_kl is not None:
                epoch_stats = torch.stack(minibatch_stats[-args.num_minibatches :])
                if epoch_stats[:, -1].mean() > args.target_kl:
                    break
        stopwatch.lap("update")

        # How far the policy moved, over the whole rollout (in minibatches, to bound the memory)
        with torch.inference_mode():
            new_logprobs = torch.cat([policy(chunk)[0].log_softmax(-1) for chunk in b_obs.split(args.minibatch_size)])
            seen_advantages = normalize(b_advantages) if args.norm_adv else b_advantages
            change = policy_change(b_logprobs, new_logprobs, b_actions, seen_advantages)
            explained_variance = 1 - (b_returns - b_values).var() / b_returns.var()
        stopwatch.lap("kl_pass")

        # Log: once an iteration, the games at the steps where they ended
        for step, score, length in games:
            last_scores.append(float(score))
            writer.add_scalar("charts/episodic_return", score, step)
            writer.add_scalar("charts/episodic_length", length, step)
        if last_scores:
            writer.add_scalar("charts/mean_return_100", np.mean(last_scores), global_step)
        names = ("policy_loss", "value_loss", "entropy", "clipfrac", "avg_clip_ratio")
        losses = dict(zip(names, torch.stack(minibatch_stats).mean(0)))
        for name, value in {**losses, **change, "explained_variance": explained_variance}.items():
            writer.add_scalar(f"losses/{name}", value.item(), global_step)
        iteration_ends.append(time.perf_counter())
        sps = (len(iteration_ends) - 1) * args.batch_size / (iteration_ends[-1] - iteration_ends[0])
        writer.add_scalar("charts/learning_rate", optimizer.param_groups[0]["lr"], global_step)
        writer.add_scalar("charts/SPS", sps, global_step)
        stopwatch.lap("logging")
        for phase, seconds in stopwatch.seconds.items():
            writer.add_scalar(f"time/{phase}", seconds, global_step)
        progress.set_postfix_str(
            f"{sps:.0f} SPS, score {np.mean(last_scores):.1f}" if last_scores else f"{sps:.0f} SPS"
        )
        progress.update(args.batch_size)

    progress.close()
    writer.close()
    envs.close()
    return agent


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    args = tyro.cli(Args)
    args.check()
    try:
        envs = make_envs(args.env_id, args.num_envs, num_threads=args.threads)
    except ValueError as error:
        refuse("env_id", args.env_id, error)
    try:
        run_dir = make_run_dir(args)  # last, so that nothing refused above leaves one behind
    except OSError as error:
        refuse("log_dir", args.log_dir, f"cannot be written ({error.strerror}); give another directory")
    train(args, envs, run_dir)


if __name__ == "__main__":
    main()
