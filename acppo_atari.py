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

Sections: arguments, network, mathematics, playing, training, command line.
"""

import ctypes
import math
import os
import re
import shlex
import shutil
import signal
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field, replace
from datetime import timedelta

if __name__ == "__main__":  # here alone: importing this file leaves the importer's process as it is
    # Idle OpenMP threads would spin on the cores that the games' threads need. torch reads this when it is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # glibc gives tensors of megabytes back to the system and faults their pages in again, 16 times an iteration:
    # keeping them takes these 16 steps from 2.1 to 1.7 s. -1: M_TRIM_THRESHOLD, -3: M_MMAP_THRESHOLD, in bytes.
    if hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-1, 1 << 30)
        if not libc.mallopt(-3, 1 << 30):
            libc.mallopt(-3, 1 << 25)  # the most that an older glibc takes

import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from wrappers import RunDirectory, StatusLine, StopSignal, Stopwatch, available_cores, env_seeds, make_envs, refuse, say


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
    """clip the value loss as CleanRL does; `--no-clip-vloss` is half the plain squared error of appendix B"""
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
    threads: int = field(default_factory=available_cores)
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
    eval_episodes: int = 10
    """whole games that are played and scored when the training is finished, without learning; 0 for none"""
    capture_video: bool = False
    """record a whole game, in `videos/` of the run: at the start, at each quarter of the training and at its end, or
    with `--evaluate` one"""
    evaluate: str | None = None
    """directory of a run whose checkpoint is to play `--eval-episodes` games; nothing is trained"""
    resume: str | None = None
    """directory of a run to go on with, under its own arguments; a flag given beside this one replaces the run's"""
    stop_at: int | None = None
    """agent steps at which this call ends, with a checkpoint, rounded up to whole rollouts; the schedule stays that of
    the whole run"""

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

    @property
    def last_iteration(self) -> int:
        """The iteration that this call ends with."""
        most = self.num_iterations if self.stop_at is None else -(-self.stop_at // self.batch_size)  # rounded up
        return min(self.num_iterations, most)

    def check(self) -> None:
        """Ends the program with status 2 at the first argument that cannot work."""
        most_threads, compiler = 4 * available_cores(), os.environ.get("CXX", "g++")
        rollout = f"num_envs · num_steps = {self.batch_size}"
        sizes = "total_timesteps num_envs num_steps num_minibatches update_epochs"
        positive = "clip_coef vf_clip_coef learning_rate max_grad_norm"
        rules = [
            (sizes, lambda x: 0 < x <= 10**12, "give a whole number from 1 to 10^12"),
            # 1e30: float32 must hold what is computed with it
            (positive, lambda x: 0 < x < 1e30, "give a number above 0 and below 1e30"),
            ("ent_coef vf_coef checkpoint_minutes", lambda x: 0 <= x < 1e30, "give a number from 0 to below 1e30"),
            ("eval_episodes", lambda x: 0 <= x <= 1_000_000, "give a whole number from 0 to 1,000,000"),
            ("c", lambda x: 0 <= x < 1e30 or x == math.inf, "give a number, 0 or above, or inf"),
            ("gamma gae_lambda", lambda x: 0 <= x <= 1, "give a number from 0 to 1"),
            ("target_kl stop_at", lambda x: x is None or x > 0, "give a number above 0, or None"),
            ("seed", lambda x: 0 <= x < 2**64, "give a whole number from 0 to 2^64 - 1"),
            ("threads", lambda x: 0 < x <= most_threads, f"give a number from 1 to {most_threads}"),
            ("exp_name", lambda x: re.fullmatch(r"[\w.-]{1,100}", x), "give up to 100 letters, digits, '.', '_', '-'"),
            ("compile", lambda x: not x or shutil.which(compiler), f"there is no C++ compiler {compiler}"),
            ("num_steps", lambda x: self.batch_size <= 1_000_000, "give a rollout of at most 1,000,000 samples"),
            ("total_timesteps", lambda x: x >= self.batch_size, f"give at least one rollout, {rollout}"),
            ("num_minibatches", lambda x: self.batch_size % x == 0, f"give a divisor of {rollout}"),
            ("num_minibatches", lambda x: x < self.batch_size or not self.norm_adv, "give fewer, or --no-norm-adv"),
            ("evaluate", lambda x: x is None or self.resume is None, "give either this or --resume"),
            ("evaluate", lambda x: x is None or self.eval_episodes > 0, "give --eval-episodes above 0, too"),
        ]
        for names, works, advice in rules:
            for name in names.split():
                if not works(getattr(self, name)):
                    refuse(name, getattr(self, name), advice)


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
        # The view makes (B, 4, 84, 84) in channels-last layout, where a gradient step takes 114 ms, 153 in torch's.
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


def from_envs(array: np.ndarray, device: torch.device) -> Tensor:
    """Moves observations to the network: screens (N, 4, 84, 84) → (N, 84, 84, 4); flat ones stay as they are."""
    return torch.from_numpy(array).to(device).movedim(1, -1)


@torch.inference_mode()
def act(agent: nn.Module, obs: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Samples actions (B,) and returns them with the log-probabilities of all actions (B, A) and the values (B,)."""
    logits, values = agent(obs)
    logprobs = logits.log_softmax(-1)  # by hand: a validated Categorical takes 1.8 times as long
    return torch.multinomial(logprobs.exp(), 1, generator=generator).squeeze(-1), logprobs, values


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
    not_done = ~(terminations | truncations)  # no advantage flows back out of the next episode
    advantages = torch.zeros_like(rewards)
    last_advantage = torch.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        advantages[t] = last_advantage = deltas[t] + gamma * gae_lambda * not_done[t] * last_advantage
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

    Args: log-probabilities of all actions before and after (B, A), the actions taken (B,), the advantages (B,),
    normalised over the rollout. `kl` and the distances are exact over actions; the other three use the action taken,
    as the thesis's chapter 4 does.
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


# ------------------------------------------------------------------------------------------------------ playing
def make_agent(args: Args, envs: VectorEnv) -> tuple[Agent, torch.device]:
    """Builds the network that fits the environment's spaces, on the device that it is used on."""
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    agent = Agent(envs.single_observation_space.shape, int(envs.single_action_space.n), args.bf16)
    return agent.to(device, memory_format=torch.channels_last), device


def play(agent: Agent, envs: VectorEnv, num_games: int, seed: list[int]) -> list[tuple[float, int]]:
    """Plays whole games as in training, actions drawn from the policy, and returns (score, agent steps) of each.

    Each environment plays a fixed share of them: of those that end first, too many would be short. All that is random
    comes from `seed`, so that a training is not disturbed. Games that do not end are left out.
    """
    device = next(agent.parameters()).device
    generator = torch.Generator(device).manual_seed(seed[0])
    obs, _ = envs.reset(seed=env_seeds(seed, envs.num_envs))
    games = [[] for _ in range(envs.num_envs)]
    # Environment n plays the games n, n + N, n + 2N, … of all
    shares = [len(range(n, num_games, envs.num_envs)) for n in range(envs.num_envs)]
    steps_left = 27_000 * max(shares)  # Atari's longest games; other environments may have no time limit
    while steps_left > 0 and any(len(played) < share for played, share in zip(games, shares, strict=True)):
        steps_left -= 1
        actions, _, _ = act(agent, from_envs(obs, device), generator)
        obs, _, _, _, infos = envs.step(actions.cpu().numpy())
        for n in np.flatnonzero(infos.get("_episode", False)):
            games[n].append((float(infos["episode"]["r"][n]), int(infos["episode"]["l"][n])))
    return [game for played, share in zip(games, shares, strict=True) for game in played[:share]]


def evaluate(args: Args, agent: Agent, run: RunDirectory, state: dict) -> None:
    """Has the agent of a checkpoint play `args.eval_episodes` games, for the terminal, TensorBoard and `eval.csv`."""
    torch.set_num_threads(args.threads)
    envs = make_envs(args.env_id, min(args.num_envs, args.eval_episodes), args.threads)
    games = play(agent, envs, args.eval_episodes, seed=[args.seed, 1])
    if len(games) < args.eval_episodes:
        say(f"{args.eval_episodes - len(games)} of {args.eval_episodes} games did not end, they are left out")
    scores = np.array([score for score, _ in games] or [math.nan])
    std = scores.std(ddof=1) if len(scores) > 1 else 0.0
    stats = {"mean": scores.mean(), "std": std, "median": np.median(scores), "min": scores.min(), "max": scores.max()}
    run.log_games(games, stats, state)
    if args.evaluate is not None and args.capture_video:  # a training has recorded its last agent already
        record_game(args, agent, run, state["global_step"])
    print(f"{len(games)} games at step {state['global_step']:,}:", *(f"{k} {v:.1f}" for k, v in stats.items()))


def record_game(args: Args, agent: Agent, run: RunDirectory, global_step: int) -> None:
    """Plays one game into `videos/` of the run, with its score in the file's name."""
    path = os.path.join(run.path, "videos", f"step_{global_step}")
    with run.reporting():
        os.makedirs(os.path.dirname(path), exist_ok=True)
        envs = make_envs(args.env_id, 1, args.threads, video=path + ".webm")
        scores = [score for score, _ in play(agent, envs, 1, seed=[args.seed, 2])]
        envs.close()
        result = f"score_{scores[0]:.10g}" if scores else "without_end"
        os.replace(path + ".webm", f"{path}_{result}.webm")


# ----------------------------------------------------------------------------------------------------- training
def train(
    args: Args, envs: VectorEnv, run: RunDirectory, state: dict | None = None, stop: StopSignal | None = None
) -> Agent:
    """Trains on `envs` as `args` say, from the checkpoint `state` where there is one; logs to `run`, returns the agent.

    Ends early at `args.stop_at` or when `stop` has noted a signal, and with status 1 at a number that is not finite.
    """
    # Setup
    stop = stop or StopSignal()  # one that listens to nothing
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.threads)
    agent, device = make_agent(args, envs)
    # eps as OpenAI's baselines have it, not torch's 1e-8; fused: 1.3 ms a step, not 5.7 (benchmark/tricks.py)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)

    # Where the run stands: at its beginning, or at its checkpoint with new games, for the emulators are not kept
    # global_step: agent steps, over all environments; starts: so far, each draws environment seeds of its own
    iteration, global_step, starts = 0, 0, 0
    last_scores = deque(maxlen=100)  # raw returns of whole games
    if state is not None:
        with run.loading():
            agent.load_state_dict(state["agent"])
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})
            for parameter, moments in optimizer.state.items():
                assert parameter.shape == moments["exp_avg"].shape == moments["exp_avg_sq"].shape
            iteration, global_step, starts = state["iteration"], state["global_step"], state["starts"]
            last_scores.extend(state["last_scores"])
            torch.set_rng_state(state["rng"][0])
            if device.type == "cuda" and len(state["rng"]) > 1:
                torch.cuda.set_rng_state(state["rng"][1])
            run.cut_back(state["event_files"])
    run.describe(args, global_step)

    # Storage: T steps of N environments. Row T of `obs` and `values` is where the rollout ends and the next begins.
    T, N = args.num_steps, args.num_envs
    next_obs, _ = envs.reset(seed=env_seeds(args.seed, N, starts))
    first_obs = from_envs(next_obs, device)
    obs = torch.zeros((T + 1, *first_obs.shape), dtype=first_obs.dtype, device=device)  # images stay uint8: 4x smaller
    values = torch.zeros((T + 1, N), device=device)
    # Of all actions, so that the KL is exact over them
    logprobs = torch.zeros((T, N, envs.single_action_space.n), device=device)
    actions = torch.zeros((T, N), dtype=torch.int64, device=device)
    rewards = torch.zeros((T, N), device=device)
    terminations = torch.zeros((T, N), dtype=torch.bool, device=device)
    truncations = torch.zeros((T, N), dtype=torch.bool, device=device)
    final_values = torch.zeros((T, N), device=device)  # V(final observation) where truncated; elsewhere stale
    obs[T] = first_obs

    # Executables: what runs the network in the loop, compiled or not, under one name
    policy = torch.compile(agent, dynamic=False) if args.compile else agent

    checkpoint_due = time.perf_counter()  # at once, so that there is something to resume from at every moment
    iteration_ends = deque([checkpoint_due], maxlen=11)  # SPS is measured over the last 10 iterations
    status_line = StatusLine()

    while True:
        stopwatch = Stopwatch()
        # Checkpoint: when due, and at the end
        finished = iteration >= args.last_iteration or stop.number != 0
        if finished or time.perf_counter() >= checkpoint_due:
            progress = {"iteration": iteration, "global_step": global_step, "starts": starts + 1}
            learner = {"agent": agent.state_dict(), "optimizer": optimizer.state_dict()["state"]}
            rng = [torch.get_rng_state(), *([torch.cuda.get_rng_state()] if device.type == "cuda" else [])]
            run.save({"args": vars(args), **progress, **learner, "last_scores": list(last_scores), "rng": rng})
            checkpoint_due = time.perf_counter() + 60 * args.checkpoint_minutes
        if args.capture_video and not stop.number and iteration in [args.num_iterations * k // 4 for k in range(5)]:
            record_game(args, agent, run, global_step)
        if finished:
            break

        iteration += 1
        stopwatch.lap("checkpoint")
        if args.anneal_lr:
            optimizer.param_groups[0]["lr"] = (1 - (iteration - 1) / args.num_iterations) * args.learning_rate

        # Rollout: T steps in N environments with the current policy
        obs[0] = obs[T]
        games = []  # (global_step, score, length in agent steps) of each game that ends
        for t in range(T):
            # Copied into the storage, because tensors made under inference_mode cannot enter a loss
            actions[t], logprobs[t], values[t] = act(policy, obs[t])
            stopwatch.lap("inference")
            next_obs, reward, terminated, truncated, infos = envs.step(actions[t].cpu().numpy())
            stopwatch.lap("environment")
            global_step += N
            obs[t + 1] = from_envs(next_obs, device)
            rewards[t] = torch.from_numpy(reward)
            terminations[t] = torch.from_numpy(terminated)
            truncations[t] = torch.from_numpy(truncated)
            if truncated.any():
                final_obs = np.stack(infos["final_obs"][truncated])  # the other rows are uninitialised memory
                # By the agent as it is: compiled, it would be compiled anew for each number of them
                final_values[t, truncations[t]] = value_of(agent, from_envs(final_obs, device))
            for n in np.flatnonzero(infos.get("_episode", False)):
                games.append((global_step, float(infos["episode"]["r"][n]), int(infos["episode"]["l"][n])))
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
        vf_clip_coef = args.vf_clip_coef if args.clip_vloss else None
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
                stats = {"policy_loss": pg_loss, "value_loss": v_loss, "entropy": entropy, "clipfrac": clipfrac}
                stats |= {"avg_clip_ratio": avg_clip_ratio, "minibatch_approx_kl": approx_kl}
                minibatch_stats.append(torch.stack(list(stats.values())).detach())
            if args.target_kl is not None:
                epoch_kl = torch.stack(minibatch_stats[-args.num_minibatches :])[:, -1].mean()  # of approx_kl, the last
                if epoch_kl > args.target_kl:
                    break
        stopwatch.lap("update")

        # How far the policy moved, over the whole rollout (in minibatches, to bound the memory)
        with torch.inference_mode():
            new_logprobs = torch.cat([policy(chunk)[0].log_softmax(-1) for chunk in b_obs.split(args.minibatch_size)])
            rollout_advantages = normalize(b_advantages) if args.norm_adv else b_advantages
            change = policy_change(b_logprobs, new_logprobs, b_actions, rollout_advantages)
            variance = b_returns.var()  # 0 where all returns are equal, which leaves nothing to explain
            explained_variance = torch.where(variance > 0, 1 - (b_returns - b_values).var() / variance, math.nan)
        stopwatch.lap("kl_pass")

        # Log: once an iteration, the games at the steps where they ended
        points = []
        for step, score, length in games:
            last_scores.append(score)
            points += [("charts/episodic_return", score, step), ("charts/episodic_length", length, step)]
        if last_scores:
            points.append(("charts/mean_return_100", np.mean(last_scores), global_step))
        losses = dict(zip(stats, torch.stack(minibatch_stats).mean(0).tolist(), strict=True))
        losses |= {name: value.item() for name, value in change.items()}
        broken = [name for name, value in losses.items() if not math.isfinite(value)]
        broken += [name for name, parameter in agent.named_parameters() if not parameter.isfinite().all()]
        if broken:  # before the checkpoint that would keep it
            say(f"{run.path}: not finite in iteration {iteration}, step {global_step}: {', '.join(broken)}")
            sys.exit(1)
        losses["explained_variance"] = explained_variance.item()  # may be NaN
        del losses["minibatch_approx_kl"]  # no curve of its own: `approx_kl` is that of the whole update
        points += [(f"losses/{name}", value, global_step) for name, value in losses.items()]
        iteration_ends.append(time.perf_counter())
        sps = (len(iteration_ends) - 1) * args.batch_size / (iteration_ends[-1] - iteration_ends[0])
        points.append(("charts/learning_rate", optimizer.param_groups[0]["lr"], global_step))
        points.append(("charts/SPS", sps, global_step))
        run.log(points)
        stopwatch.lap("logging")
        run.log([(f"time/{phase}", seconds, global_step) for phase, seconds in stopwatch.seconds.items()])
        left = timedelta(seconds=int((args.last_iteration - iteration) * args.batch_size / sps))
        score = f", score {np.mean(last_scores):.1f}" if last_scores else ""
        line = f"step {global_step:,} of {args.last_iteration * args.batch_size:,}, {sps:.0f} SPS{score}, {left} left"
        status_line.show(line, last=iteration == args.last_iteration)

    envs.close()
    return agent


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    # TensorBoard's thread prints a traceback when the disk is full; RunDirectory says it in one line
    threading.excepthook = lambda fault: issubclass(fault.exc_type, OSError) or threading.__excepthook__(fault)
    args = tyro.cli(Args, description=__doc__)
    stop = StopSignal()
    stop.listen()
    state = None
    flag = "evaluate" if args.resume is None else "resume"
    directory = getattr(args, flag)
    if directory is not None:
        run, state = RunDirectory.open(directory, flag, Args)
        given = {"resume": args.resume, "evaluate": args.evaluate}
        if flag == "evaluate":  # these are the call's, not the run's
            given |= {name: getattr(Args(), name) for name in ("capture_video", "compile", "eval_episodes", "threads")}
        args = tyro.cli(Args, default=replace(Args(**state["args"]), **given))
        for name in ("env_id", "num_envs", "num_steps", "seed", "exp_name", "log_dir"):
            if getattr(args, name) != state["args"][name]:
                refuse(name, getattr(args, name), f"the run has {state['args'][name]}, which cannot change")
    args.check()
    if args.resume is not None and state["iteration"] >= args.last_iteration:
        limit = "--total-timesteps" if state["iteration"] >= args.num_iterations else "--stop-at"
        print(f"{args.resume} is finished up to {limit}, at step {state['global_step']}; a larger one takes it further")
        return
    try:
        envs = make_envs(args.env_id, args.num_envs if args.evaluate is None else 1, args.threads)
        if args.capture_video:
            make_envs(args.env_id, 1, video="none yet")  # refused now, if it cannot be rendered
    except ValueError as error:
        refuse("env_id", args.env_id, error)
    if state is None:
        run = RunDirectory.make(args)  # last, so that nothing refused above leaves one behind
    if args.evaluate is None:
        agent = train(args, envs, run, state, stop)
    else:
        agent, _ = make_agent(args, envs)
        with run.loading("evaluate"):
            agent.load_state_dict(state["agent"])
    stop.listen(signal.SIG_DFL)  # there is nothing left to save
    if run.failed:
        sys.exit(1)
    state = run.load(Args)  # as the last save left it
    if stop.number and state["iteration"] < args.last_iteration:
        stop_at = [] if args.stop_at is None else ["--stop-at", str(args.stop_at)]
        say(f"Stopped; go on with: {shlex.join([sys.executable, __file__, '--resume', run.path, *stop_at])}")
        sys.exit(128 + stop.number)
    finished = args.last_iteration == args.num_iterations and not stop.number
    if args.evaluate is not None or (finished and args.eval_episodes > 0):
        evaluate(args, agent, run, state)
    sys.exit(1 if run.failed else 0)


if __name__ == "__main__":
    main()
