"""PPO on Atari: the baseline of the thesis (sections 2.4 to 2.6, hyperparameters of appendix A).

The clipped surrogate (equation 2.14), generalised advantages (section 2.5), a clipped value loss and an entropy bonus.
    python ppo_atari.py --env-id Breakout
    tensorboard --logdir runs

8 games at once, 5,000,000 agent steps = 20,000,000 emulator frames: hours on a CPU (docs/speed.md has measured speeds).
Scores, losses and how far each update moved the policy go to TensorBoard; docs/curves.md defines every curve, and
docs/thesis.md has the equations. `--resume` continues a stopped or killed run. ppo_atari.py and acppo_atari.py are
siblings: every change goes into both, so that their diff is AC-PPO and nothing else. wrappers.py has the environments;
bookkeeping.py has checkpoints, logging, signals, evaluation and videos.

Sections: arguments, network, mathematics, training, command line.
"""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import bookkeeping

if __name__ == "__main__":  # not on import: it changes settings of the whole process
    bookkeeping.tune_process()  # before torch is imported

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from torch import Tensor, nn

from bookkeeping import (
    FileName,
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    RunArgs,
    RunDirectory,
    StatusLine,
    StopSignal,
    Stopwatch,
)
from wrappers import env_seeds


# ---------------------------------------------------------------------------------------------------- arguments
@dataclass
class Args(RunArgs):
    env_id: str = "Breakout"
    """the environment: an Atari game by its bare name (thesis protocol), `ALE/Breakout-v5` (the same with sticky
    actions), or a Gymnasium id with discrete actions such as `CartPole-v1`"""
    total_timesteps: PositiveInt = 5_000_000
    """agent steps of the whole run, summed over environments; one is 4 Atari frames, so the default is the
    thesis's 20M frames (chapter 4). Rounded down to whole rollouts"""
    learning_rate: PositiveFloat = 2.5e-4
    """Adam's step size at the start (appendix A)"""
    num_envs: PositiveInt = 8
    """environments played at once, N (appendix A)"""
    num_steps: PositiveInt = 128
    """agent steps of each environment in one rollout, T (appendix A)"""
    anneal_lr: bool = True
    """let the learning rate fall linearly to 0 over the run (appendix A)"""
    gamma: Fraction = 0.99
    """discount rate per agent step, γ (appendix A)"""
    gae_lambda: Fraction = 0.95
    """λ of the generalised advantage estimator (section 2.5, appendix A)"""
    num_minibatches: PositiveInt = 4
    """minibatches that a rollout is cut into: N·T / 4 = 256 samples each at the defaults (appendix A)"""
    update_epochs: PositiveInt = 4
    """passes over each rollout (appendix A)"""
    norm_adv: bool = True
    """normalise the advantages of each minibatch (appendix B, line 28)"""
    clip_coef: PositiveFloat = 0.1
    """clip range of the probability ratio, ε (2.14, appendix A)"""
    clip_vloss: bool = True
    """clip the value loss as CleanRL does; `--no-clip-vloss` gives half the squared error (appendix B: all of it)"""
    vf_clip_coef: PositiveFloat = 0.1
    """how far a value may move towards its return in one iteration before its gradient is cut off, in units of return
    (CleanRL reuses clip_coef; a coefficient of its own keeps ε out of the value loss)"""
    ent_coef: NonNegativeFloat = 0.01
    """weight of the entropy bonus, c₂ (appendix A)"""
    vf_coef: NonNegativeFloat = 0.5
    """weight of the value loss, c₁ (CleanRL)"""
    max_grad_norm: PositiveFloat = 0.5
    """the gradient's norm is clipped to this (appendix A)"""
    target_kl: PositiveFloat | None = None
    """skip the remaining epochs once the mean of (ρ - 1) - log ρ over an epoch exceeds this, in nats (CleanRL,
    which looks at the last minibatch)"""
    seed: NonNegativeInt = 1
    """seed of torch, and of a SeedSequence that gives each environment a seed of its own"""
    torch_deterministic: bool = True
    """have cuDNN choose deterministic algorithms (CleanRL); on one machine's CPU, seed and threads determine the run"""
    cuda: bool = True
    """use a GPU if there is one"""
    bf16: bool = False
    """run the network's trunk in bfloat16 (ours): faster on processors with AVX512-BF16 or AMX (Linux's `lscpu` lists
    avx512_bf16 or amx_bf16), far slower on others; parameters, logits, values and losses stay float32"""
    exp_name: FileName = Path(__file__).stem
    """name of the experiment, part of the run's name"""

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

    def rules(self) -> list[tuple[str, bool, str]]:
        """Returns (argument, does it hold, advice) for each rule that involves several arguments."""
        rollout = f"num_envs · num_steps = {self.batch_size}"
        return [
            ("num_steps", self.batch_size <= 1_000_000, "give a rollout of at most 1,000,000 samples"),
            ("total_timesteps", self.total_timesteps >= self.batch_size, f"give at least one rollout, {rollout}"),
            ("num_minibatches", self.batch_size % self.num_minibatches == 0, f"give a divisor of {rollout}"),
            ("num_minibatches", self.minibatch_size > 1 or not self.norm_adv, "give fewer, or --no-norm-adv"),
            *super().rules(),
        ]


# ------------------------------------------------------------------------------------------------------ network
class Agent(nn.Module):
    """Policy and value function: a shared Nature CNN for images; for flat inputs, a small tanh MLP for each."""

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
        # A channels-last view: in torch's own layout a gradient step takes 1.2 times as long (benchmark/tricks.py)
        x = obs.movedim(-1, 1)
        if obs.dtype == torch.uint8:
            # Straight to the trunk's precision: bfloat16 holds 0 to 255 exactly, so the quotient is rounded once
            # either way. In place: x / 255 takes 1.6 times as long
            x = x.to(torch.bfloat16 if self.bf16 else torch.float32).div_(255.0)
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.bf16):  # only the trunk: ratios need float32
            hidden = self.network(x).float()
        return self.actor(hidden), self.critic(hidden).squeeze(-1)

    def snapshot(self) -> "Agent":
        """Returns the agent as it is now, to act with until it learns on: a copy with `bf16`, otherwise itself.

        The copy's trunk is in bfloat16. Autocast would cast its weights at every call, for which 8 screens take 1.5
        times as long (benchmark/tricks.py); the results are equal bit for bit.
        """
        if not self.bf16:
            return self
        snapshot = copy.deepcopy(self)
        snapshot.network.bfloat16()
        return snapshot


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
    """Moves observations to the device, channels last: (N, 4, 84, 84) → (N, 84, 84, 4); flat ones stay as they are."""
    return torch.from_numpy(array).to(device).movedim(1, -1)


@torch.inference_mode()
def act(agent: nn.Module, obs: Tensor, generator: torch.Generator | None = None) -> tuple[Tensor, Tensor, Tensor]:
    """Samples actions (B,) and returns them with the log-probabilities of all actions (B, A) and the values (B,)."""
    logits, values = agent(obs)
    logprobs = logits.log_softmax(-1)  # not a Categorical, which takes 1.7 times as long
    return torch.multinomial(logprobs.exp(), 1, generator=generator).squeeze(-1), logprobs, values


@torch.inference_mode()
def get_value(agent: nn.Module, obs: Tensor) -> Tensor:
    """Returns the values (B,) of observations."""
    return agent(obs)[1]


def make_agent(args: Args, envs: VectorEnv) -> Agent:
    """Builds the network that fits the environments' spaces, on the GPU if there is one and `args` allow it."""
    agent = Agent(envs.single_observation_space.shape, int(envs.single_action_space.n), args.bf16)
    device = "cuda" if args.cuda and torch.cuda.is_available() else "cpu"
    return agent.to(device, memory_format=torch.channels_last)


def make_policy(agent: Agent, seed: int) -> Callable[[np.ndarray], np.ndarray]:
    """Returns the agent as a function, observations (N, …) → sampled actions (N,), with a random generator of its own.

    Evaluations and videos use it, so that the training's random numbers stay the same with and without them.
    """
    device, agent = next(agent.parameters()).device, agent.snapshot()
    generator = torch.Generator(device).manual_seed(seed)
    return lambda obs: act(agent, from_envs(obs, device), generator)[0].cpu().numpy()


# -------------------------------------------------------------------------------------------------- mathematics
def compute_gae(rewards, values, next_values, terminations, truncations, gamma: float, gae_lambda: float) -> Tensor:
    """Returns the generalised advantages (T, N) of a rollout: section 2.5, with the masks that appendix B lacks.

    Args, tensors (T, N): `rewards`; `values`, V(s_t); `next_values`, V(s_{t+1}), or V(final observation) if the episode
    was truncated at t; `terminations` and `truncations`, bool. After a termination nothing follows; after a truncation
    the episode would have gone on.
    """
    deltas = rewards + gamma * next_values * ~terminations - values  # δ_t
    not_done = ~(terminations | truncations)  # the sum of an episode stops at its end
    advantages = torch.zeros_like(deltas)  # in floats, also for whole-number rewards
    last_advantage = torch.zeros_like(deltas[0])
    for t in reversed(range(len(rewards))):
        advantages[t] = last_advantage = deltas[t] + gamma * gae_lambda * not_done[t] * last_advantage
    return advantages


def normalize(advantages: Tensor) -> Tensor:
    """Shifts and scales to mean 0 and standard deviation 1 (appendix B, line 28)."""
    return (advantages - advantages.mean()) / (advantages.std() + 1e-8)


def clip_range(advantages: Tensor, clip_coef: float) -> Tensor:
    """Returns how far each sample's ratio may leave 1 (B,): ε, whatever the advantage (2.14)."""
    return torch.full_like(advantages, clip_coef)


def surrogate(ratio: Tensor, advantages: Tensor, clip: Tensor) -> Tensor:
    """Returns the clipped objective of each sample (B,), to be maximised: the term inside the expectation of (2.14)."""
    # A ratio beyond its range has no gradient if it has moved as the advantage wants, and keeps it if not
    return torch.min(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)


def value_loss(new_values, values, returns, vf_clip_coef: float | None) -> Tensor:
    """Returns half the mean squared error of values (B,); with `vf_clip_coef`, the larger of plain and clipped."""
    squared_error = (new_values - returns).square()
    if vf_clip_coef is not None:
        clipped = values + (new_values - values).clamp(-vf_clip_coef, vf_clip_coef)
        squared_error = torch.max(squared_error, (clipped - returns).square())
    return 0.5 * squared_error.mean()


def policy_change(logprobs, new_logprobs, actions, advantages) -> dict[str, Tensor]:
    """Measures how far an update moved the policy on the B states of its rollout (docs/curves.md defines each name).

    Args: log-probabilities of all actions before and after (B, A), the actions taken (B,), the advantages (B,),
    normalised over the rollout unless `norm_adv` is off. `kl` and the distances are exact over actions; the other three
    use the action taken, as the thesis's chapter 4 does.
    """
    logratio = (new_logprobs - logprobs).gather(1, actions[:, None]).squeeze(1)
    ratio = logratio.exp()
    tv_distance = 0.5 * (new_logprobs.exp() - logprobs.exp()).abs().sum(1)
    return {
        "kl": (logprobs.exp() * (logprobs - new_logprobs)).sum(1).mean().clamp(min=0),  # rounding may take it below
        "old_approx_kl": -logratio.mean(),
        "approx_kl": ((ratio - 1) - logratio).mean(),
        "tv_distance": tv_distance.mean(),
        "max_tv_distance": tv_distance.max(),
        "max_ratio_advantage": ((ratio - 1) * advantages).abs().max(),
    }


# ----------------------------------------------------------------------------------------------------- training
def train(
    args: Args, envs: VectorEnv, run: RunDirectory, state: dict | None = None, stop: StopSignal | None = None
) -> Agent:
    """Trains on `envs` as `args` say, afresh or from the checkpoint `state`; logs to `run` and returns the agent.

    Ends early at `args.stop_at`, or when `stop` has noted a signal. Raises FloatingPointError if a loss, a
    parameter or a measure of the policy's change is not finite, before that reaches a checkpoint.
    """
    # Setup
    stop = stop or StopSignal()  # one that no signal reaches
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.threads)
    agent = make_agent(args, envs)
    device = next(agent.parameters()).device
    # eps as in OpenAI's baselines, not torch's 1e-8; fused, it takes a quarter of the time (benchmark/tricks.py)
    optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
    iterations_done = run.start(args, state, agent, optimizer)
    run.save(args, iterations_done, agent, optimizer)  # to be resumed from at once; counts this start
    vf_clip_coef = args.vf_clip_coef if args.clip_vloss else None
    fresh_policy = partial(make_policy, agent, args.seed)  # with a new generator for each film
    bookkeeping.record_game_if_due(args, fresh_policy, run, iterations_done, stop)

    # Storage: T steps of N environments. Row T follows them: its observations begin the next rollout.
    T, N = args.num_steps, args.num_envs
    next_obs, _ = envs.reset(seed=env_seeds(args.seed, N, run.num_starts))
    stop.listen_again()  # now that environments have been built, which may take signals for themselves
    first_obs = from_envs(next_obs, device)
    obs = torch.zeros((T + 1, *first_obs.shape), dtype=first_obs.dtype, device=device)  # images stay uint8: 4x smaller
    values = torch.zeros((T + 1, N), device=device)
    logprobs = torch.zeros((T, N, envs.single_action_space.n), device=device)  # of all actions, for an exact KL
    actions = torch.zeros((T, N), dtype=torch.int64, device=device)
    rewards = torch.zeros((T, N), device=device)
    terminations = torch.zeros((T, N), dtype=torch.bool, device=device)
    truncations = torch.zeros((T, N), dtype=torch.bool, device=device)
    final_values = torch.zeros((T, N), device=device)  # V(final observation), read where an episode was truncated
    obs[T] = first_obs
    stopwatch, status_line = Stopwatch(), StatusLine()

    for iteration in range(iterations_done + 1, args.last_iteration + 1):
        if args.anneal_lr:
            optimizer.param_groups[0]["lr"] = (1 - (iteration - 1) / args.num_iterations) * args.learning_rate

        # Rollout: T steps in N environments with the current policy
        global_step = (iteration - 1) * args.batch_size  # agent steps, over all environments
        snapshot = agent.snapshot()
        obs[0] = obs[T]
        games = []  # (global_step, score, length in agent steps) of each game that ends
        stopwatch.lap("rest")
        for t in range(T):
            # Copied into the storage, because tensors made under inference_mode cannot enter a loss
            actions[t], logprobs[t], values[t] = act(snapshot, obs[t])
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
                final_values[t, truncations[t]] = get_value(snapshot, from_envs(final_obs, device))
            for n in np.flatnonzero(infos.get("_episode", False)):
                games.append((global_step, float(infos["episode"]["r"][n]), int(infos["episode"]["l"][n])))
            stopwatch.lap("rest")

        # Advantages, and the TD(λ) returns that the values are fitted to
        values[T] = get_value(snapshot, obs[T])
        next_values = torch.where(truncations, final_values, values[1:])
        advantages = compute_gae(
            rewards, values[:T], next_values, terminations, truncations, args.gamma, args.gae_lambda
        )
        returns = advantages + values[:T]
        # (T, N, …) → (T·N, …)
        b_obs, b_values = obs[:T].flatten(0, 1), values[:T].flatten()
        b_logprobs, b_actions = logprobs.flatten(0, 1), actions.flatten()
        b_advantages, b_returns = advantages.flatten(), returns.flatten()
        stopwatch.lap("rest")

        # Update: several epochs of minibatch gradient steps on the rollout
        names = ("policy_loss", "value_loss", "entropy", "clipfrac", "avg_clip_ratio", "grad_norm")
        minibatch_stats = []  # tensors of these, read once an iteration: .item() in here would wait for the device
        for _ in range(args.update_epochs):
            minibatch_kls = []
            for mb_inds in torch.randperm(args.batch_size, device=device).split(args.minibatch_size):
                # index_select copies whole screens; b_obs[mb_inds] takes ten times as long
                logits, new_values = agent(b_obs.index_select(0, mb_inds))
                new_logprobs = logits.log_softmax(-1)
                logratio = (new_logprobs - b_logprobs[mb_inds]).gather(1, b_actions[mb_inds, None]).squeeze(1)
                ratio = logratio.exp()  # ρ; 1 in the first minibatch, but for rounding
                mb_advantages = b_advantages[mb_inds]
                if args.norm_adv:
                    mb_advantages = normalize(mb_advantages)

                clip = clip_range(mb_advantages, args.clip_coef)
                pg_loss = -surrogate(ratio, mb_advantages, clip).mean()
                v_loss = value_loss(new_values, b_values[mb_inds], b_returns[mb_inds], vf_clip_coef)
                entropy = -(new_logprobs.exp() * new_logprobs).sum(-1).mean()
                loss = pg_loss + args.vf_coef * v_loss - args.ent_coef * entropy

                optimizer.zero_grad()
                loss.backward()
                grad_norm = nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()

                with torch.no_grad():
                    minibatch_kls.append(((ratio - 1) - logratio).mean())
                    clipfrac = ((ratio - 1).abs() > clip).float().mean()  # each sample against its own range
                    avg_clip_ratio = clip.clamp(max=1).mean()  # a range above 1 has no lower end
                    stats = [pg_loss, v_loss, entropy, clipfrac, avg_clip_ratio, grad_norm]
                    minibatch_stats.append(torch.stack(stats))
            if args.target_kl is not None and torch.stack(minibatch_kls).mean() > args.target_kl:
                break
        stopwatch.lap("update")

        # How far the policy moved, over the whole rollout (in minibatches, to bound the memory)
        with torch.inference_mode():
            new_logprobs = torch.cat([agent(chunk)[0].log_softmax(-1) for chunk in b_obs.split(args.minibatch_size)])
            rollout_advantages = normalize(b_advantages) if args.norm_adv else b_advantages
            change = policy_change(b_logprobs, new_logprobs, b_actions, rollout_advantages)
            variance = b_returns.var()  # 0 if all returns are equal, which leaves nothing to explain
            explained_variance = torch.where(variance > 0, 1 - (b_returns - b_values).var() / variance, math.nan)
        stopwatch.lap("kl_pass")

        # Log: once an iteration; the games at the steps where they ended
        losses = dict(zip(names, torch.stack(minibatch_stats).mean(0).tolist(), strict=True))
        losses |= {name: value.item() for name, value in change.items()}
        broken = [name for name, value in losses.items() if not math.isfinite(value)]
        broken += [name for name, parameter in agent.named_parameters() if not parameter.isfinite().all()]
        if broken:
            raise FloatingPointError(f"not finite in iteration {iteration}, step {global_step}: {', '.join(broken)}")
        losses["explained_variance"] = explained_variance.item()  # may be NaN
        charts = {"charts/learning_rate": optimizer.param_groups[0]["lr"], **stopwatch.end_iteration(args.batch_size)}
        run.log(global_step, {**charts, **{f"losses/{name}": value for name, value in losses.items()}}, games)
        status_line.show(args, iteration, charts["charts/SPS"], run.last_scores)

        # Film and checkpoint
        bookkeeping.record_game_if_due(args, fresh_policy, run, iteration, stop)
        stopping = stop.number != 0  # read once: a signal after this line is served after the next iteration
        if stopping or iteration == args.last_iteration or run.is_checkpoint_due():
            run.save(args, iteration, agent, optimizer)
        if stopping:
            break

    envs.close()
    return agent


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    args, envs, run, state, stop = bookkeeping.open_run(Args, description=__doc__)
    with bookkeeping.ending_in_one_line(args, run, stop):
        if args.evaluate is None:
            agent = train(args, envs, run, state, stop)
        else:
            agent = make_agent(args, envs)
            run.restore_agent(state, agent)
        bookkeeping.finish(args, partial(make_policy, agent, args.seed), run, stop)


if __name__ == "__main__":
    main()
