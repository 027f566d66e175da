"""Whole trainings in this process: equalities, zeros, and every logged number worked out again."""

import time

import numpy as np
import pytest
import torch
from torch.optim.optimizer import register_optimizer_step_pre_hook

import acppo_atari
import ppo_atari
from conftest import SHORT_CARTPOLE, TINY_PIXELS, open_run, reproducible, scalars, train, values
from wrappers import env_seeds, make_envs

UPDATE = {"num_minibatches": 4, "update_epochs": 4}  # counted on below; a script of one's own may have other defaults
# Two small rollouts of each kind. Screens take a large network, so that of them there are fewer.
CARTPOLE = {"env_id": "CartPole-v1", "num_envs": 4, "num_steps": 32, "total_timesteps": 256, **UPDATE}
SCREENS = {"num_envs": 2, "num_steps": 16, "total_timesteps": 64, **UPDATE}
ONE_ROLLOUT = {**CARTPOLE, "total_timesteps": 128}


@pytest.mark.parametrize("arguments", [CARTPOLE, {"env_id": "Breakout", **SCREENS}], ids=["CartPole", "Breakout"])
def test_acppo_with_c_zero_equals_ppo_bitwise(arguments, tmp_path):
    ppo = train(ppo_atari, tmp_path / "ppo", clip_coef=0.16, **arguments)
    acppo = train(acppo_atari, tmp_path / "acppo", clip_coef=0.16, c=0.0, **arguments)
    assert reproducible(ppo) == reproducible(acppo)
    assert values(ppo, "losses/clipfrac").size == 2


def test_cartpole_is_learnt(script, tmp_path):
    logged = train(script, tmp_path, env_id="CartPole-v1", total_timesteps=60_000)
    assert values(logged, "charts/mean_return_100")[-1] > 150


@pytest.mark.thesis
@pytest.mark.slow
def test_the_readmes_flags_for_vectors_solve_cartpole(script, tmp_path):
    flags = {"learning_rate": 2.5e-3, "num_steps": 32, "ent_coef": 0.0, "clip_vloss": False}
    logged = train(script, tmp_path, env_id="CartPole-v1", total_timesteps=100_000, **flags)
    assert values(logged, "charts/mean_return_100")[-1] >= 450  # of 500


def test_the_learning_rate_falls_linearly_over_all_steps(script, tmp_path):
    logged = train(script, tmp_path, learning_rate=0.01, **{**CARTPOLE, "total_timesteps": 640})
    steps, rates = zip(*logged["charts/learning_rate"])
    assert steps == (128, 256, 384, 512, 640)
    assert rates == pytest.approx((0.01, 0.008, 0.006, 0.004, 0.002))
    constant = train(script, tmp_path / "constant", learning_rate=0.01, anneal_lr=False, **CARTPOLE)
    assert values(constant, "charts/learning_rate") == pytest.approx([0.01, 0.01])


class Recorder:
    """Keeps the arguments and results of one of a script's functions."""

    def __init__(self, monkeypatch, script, name: str):
        self.calls, function = [], getattr(script, name)

        def recorded(*given, **named):
            result = function(*given, **named)
            self.calls.append(([x.detach().clone() if torch.is_tensor(x) else x for x in given], result))
            return result

        monkeypatch.setattr(script, name, recorded)


def log_softmax(logits: torch.Tensor) -> np.ndarray:
    logits = logits.detach().numpy().astype(np.float64)
    return logits - np.log(np.exp(logits).sum(1, keepdims=True))


@pytest.mark.parametrize(
    "arguments", [ONE_ROLLOUT, {**SCREENS, "env_id": TINY_PIXELS, "total_timesteps": 32}], ids=["CartPole", "pixels"]
)
def test_every_logged_metric_is_what_it_is_defined_to_be(script, arguments, tmp_path, monkeypatch):
    """One iteration with a large step; its rollout is kept, and each number worked out again in numpy."""
    args = script.Args(threads=1, seed=3, learning_rate=0.01, clip_coef=0.1, **arguments)
    torch.manual_seed(args.seed)
    envs = make_envs(args.env_id, args.num_envs)
    before = script.Agent(envs.single_observation_space.shape, 2)  # the same first draws as in train

    rollout, gae = Recorder(monkeypatch, script, "act"), Recorder(monkeypatch, script, "compute_gae")
    objective, fit = Recorder(monkeypatch, script, "surrogate"), Recorder(monkeypatch, script, "value_loss")
    with open_run(script, tmp_path) as run:
        after = script.train(args, envs, run)
    logged = {tag: points[0][1] for tag, points in scalars(tmp_path).items()}

    obs = torch.cat([given[1] for given, _ in rollout.calls])
    actions = torch.cat([result[0] for _, result in rollout.calls]).numpy()
    old, new = (log_softmax(agent(obs)[0]) for agent in (before, after))
    taken = np.arange(len(actions)), actions
    (given, advantages) = gae.calls[0]
    advantages, returns = advantages.flatten().numpy(), (advantages + given[1]).flatten().numpy()
    normalised = (advantages - advantages.mean()) / advantages.std(ddof=1)
    logratio = new[taken] - old[taken]
    tv_distance = 0.5 * np.abs(np.exp(new) - np.exp(old)).sum(1)
    expected = {
        "kl": (np.exp(old) * (old - new)).sum(1).mean(),
        "old_approx_kl": (old[taken] - new[taken]).mean(),
        "approx_kl": (np.exp(logratio) - 1 - logratio).mean(),
        "tv_distance": tv_distance.mean(),
        "max_tv_distance": tv_distance.max(),
        "max_ratio_advantage": np.abs((np.exp(logratio) - 1) * normalised).max(),
        "explained_variance": 1 - (returns - given[1].flatten().numpy()).var() / returns.var(),
        "value_loss": np.mean([result.item() for _, result in fit.calls]),
        "policy_loss": -np.mean([result.mean().item() for _, result in objective.calls]),
    }

    clipped, ranges = [], []
    for (ratio, _, own_range, *_), _ in objective.calls:  # test_fast_form.py knows which range that is
        clipped.append(((ratio - 1).abs() > own_range).numpy().mean())
        ranges.append(own_range.clamp(max=1).mean().item())
    expected |= {"clipfrac": np.mean(clipped), "avg_clip_ratio": np.mean(ranges)}

    assert len(objective.calls) == 16 and expected["kl"] > 1e-4 and expected["clipfrac"] > 0.01
    for name, value in expected.items():
        assert logged[f"losses/{name}"] == pytest.approx(value, rel=1e-3, abs=1e-6), name


def test_the_loss_is_the_weighted_sum_of_its_parts(script, tmp_path, monkeypatch):
    """In the first minibatch, whose policy is the new network's; whatever the surrogate and the value loss are."""
    weights = {"vf_coef": 0.7, "ent_coef": 0.3}
    torch.manual_seed(1)
    before = script.Agent((4,), 2)
    rollout = Recorder(monkeypatch, script, "act")
    objective, fit = Recorder(monkeypatch, script, "surrogate"), Recorder(monkeypatch, script, "value_loss")
    losses, backward = [], torch.Tensor.backward
    monkeypatch.setattr(torch.Tensor, "backward", lambda loss: losses.append(loss.item()) or backward(loss))
    arguments = {**ONE_ROLLOUT, "num_minibatches": 1, "update_epochs": 1}
    logged = train(script, tmp_path, norm_adv=False, **arguments, **weights)
    policy = log_softmax(before(torch.cat([given[1] for given, _ in rollout.calls]))[0])
    entropy = -(np.exp(policy) * policy).sum(1).mean()
    surrogate, value_loss = objective.calls[0][1].mean().item(), fit.calls[0][1].item()
    expected = -surrogate + weights["vf_coef"] * value_loss - weights["ent_coef"] * entropy
    assert value_loss > 0.1 and entropy > 0.1
    why = "if a further term is the script's idea, leave this test out by --deselect"
    assert losses == [pytest.approx(expected, rel=1e-4)], why
    assert values(logged, "losses/entropy") == pytest.approx([entropy], rel=1e-5)


def test_every_epoch_takes_every_sample_once_in_an_order_of_its_own(script, tmp_path, monkeypatch):
    objective, gae = Recorder(monkeypatch, script, "surrogate"), Recorder(monkeypatch, script, "compute_gae")
    train(script, tmp_path, norm_adv=False, **ONE_ROLLOUT)
    epochs = torch.cat([given[1] for given, _ in objective.calls]).reshape(4, 128)
    for epoch, before in zip(epochs, [gae.calls[0][1].flatten(), *epochs]):
        assert torch.equal(epoch.sort().values, before.sort().values) and not torch.equal(epoch, before)


@pytest.mark.parametrize(("clip_vloss", "expected"), [(True, 0.3), (False, None)])
def test_the_value_loss_is_clipped_unless_it_is_switched_off(script, clip_vloss, expected, tmp_path, monkeypatch):
    fit = Recorder(monkeypatch, script, "value_loss")
    train(script, tmp_path, clip_vloss=clip_vloss, vf_clip_coef=0.3, **CARTPOLE)
    assert {given[3] for given, _ in fit.calls} == {expected}


def test_the_gradients_norm_is_clipped_and_logged_as_it_was(script, tmp_path):
    """At learning rate 0 a training with a norm that nothing exceeds has the same gradients."""
    norms, epsilons = [], set()

    def keep_norm(optimizer, *_):
        epsilons.add(optimizer.param_groups[0]["eps"])
        gradients = [parameter.grad.flatten() for group in optimizer.param_groups for parameter in group["params"]]
        norms.append(torch.cat(gradients).norm().item())

    hook = register_optimizer_step_pre_hook(keep_norm)
    arguments = {**CARTPOLE, "learning_rate": 0.0}
    train(script, tmp_path / "free", max_grad_norm=1e9, **arguments)
    logged = train(script, tmp_path / "clipped", max_grad_norm=0.02, **arguments)
    hook.remove()
    free, clipped = np.split(np.array(norms), 2)
    assert clipped == pytest.approx([0.02] * 32, rel=1e-3)
    assert values(logged, "losses/grad_norm") == pytest.approx(free.reshape(2, 16).mean(1), rel=1e-4)
    assert epsilons == {1e-5}  # OpenAI's baselines' and CleanRL's; torch's own is 1e-8


@pytest.mark.thesis("Agent")
def test_every_rollout_under_bfloat16_is_of_the_latest_policy(script, tmp_path, monkeypatch):
    """A ratio is 1 in an iteration's first minibatch, but for the rounding of other sizes of a batch."""
    objective = Recorder(monkeypatch, script, "surrogate")
    train(script, tmp_path, bf16=True, learning_rate=0.01, env_id=TINY_PIXELS, **SCREENS)
    first, last = objective.calls[16][0][0], objective.calls[15][0][0]
    assert (first - 1).abs().max() < 0.05 < (last - 1).abs().max()


def test_actions_rewards_and_scores_are_those_of_the_environments(script, tmp_path, monkeypatch):
    """The environments are played again with the recorded actions."""
    args = script.Args(env_id=SHORT_CARTPOLE, num_envs=8, num_steps=64, total_timesteps=2048, seed=5, threads=1)
    rollout, gae = Recorder(monkeypatch, script, "act"), Recorder(monkeypatch, script, "compute_gae")
    with open_run(script, tmp_path) as run:
        script.train(args, make_envs(SHORT_CARTPOLE, 8), run)
    envs = make_envs(SHORT_CARTPOLE, 8)
    obs, _ = envs.reset(seed=env_seeds(args.seed, 8))
    rewards, scores, lengths = [], [], []
    for t, (given, (actions, _, _)) in enumerate(rollout.calls, start=1):
        assert np.array_equal(given[1], obs)  # also where a rollout begins
        obs, reward, terminated, truncated, infos = envs.step(actions.numpy())
        rewards.append(reward)
        for n in np.flatnonzero(terminated | truncated):
            scores.append((8 * t, infos["episode"]["r"][n]))
            lengths.append((8 * t, infos["episode"]["l"][n]))
    assert np.array_equal(np.concatenate([given[0] for given, _ in gae.calls]), rewards)
    logged = scalars(tmp_path)
    assert logged["charts/episodic_return"] == scores and logged["charts/episodic_length"] == lengths
    assert len(scores) > 120
    last_hundred = [np.mean([score for step, score in scores if step <= end][-100:]) for end in (512, 1024, 1536, 2048)]
    assert values(logged, "charts/mean_return_100") == pytest.approx(last_hundred)


def test_speed_and_phases_are_the_times_that_their_parts_take(script, tmp_path, monkeypatch):
    """By a clock that only moves in the parts, by a number of seconds that is the part's own."""
    args = script.Args(**{**CARTPOLE, "num_steps": 8, "total_timesteps": 64}, checkpoint_minutes=0, threads=1)
    envs, clock = make_envs(args.env_id, args.num_envs), [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])

    def takes(seconds: float, owner, name: str) -> None:
        function = getattr(owner, name)

        def slow(*given):
            clock[0] += seconds
            return function(*given)

        monkeypatch.setattr(owner, name, slow)

    takes(1, script, "act")
    takes(10, envs, "step")
    takes(5, script, "from_envs")
    takes(200, script, "compute_gae")
    takes(1000, script, "surrogate")
    takes(30_000, script, "policy_change")
    with open_run(script, tmp_path) as run:
        takes(2_000_000, run, "log")
        takes(400_000, run, "save")
        script.train(args, envs, run)
    logged = scalars(tmp_path)
    phases = {"inference": 8, "environment": 80, "update": 16_000, "kl_pass": 30_000}
    for phase, seconds in phases.items():
        assert list(values(logged, f"time/{phase}")) == [seconds] * 2, phase
    # Storage and advantages; logging and a checkpoint count in the iteration after them, the first in none
    assert list(values(logged, "time/rest")) == [40 + 200, 40 + 200 + 2_000_000 + 400_000]
    first = sum(phases.values()) + 40 + 200
    assert values(logged, "charts/SPS") == pytest.approx([32 / first, 64 / (2 * first + 2_400_000)])


def test_the_variance_of_equal_returns_leaves_nothing_to_explain(script, tmp_path):
    logged = train(script, tmp_path, gamma=0.0, gae_lambda=0.0, **{**ONE_ROLLOUT, "env_id": "tiny_envs:Endless-v0"})
    assert np.isnan(values(logged, "losses/explained_variance")).all()


def test_the_average_clip_ratio_counts_a_range_above_one_as_one(tmp_path):
    logged = train(acppo_atari, tmp_path, c=float("inf"), clip_coef=1e6, **CARTPOLE)
    assert values(logged, "losses/avg_clip_ratio") == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("env_id", [TINY_PIXELS, SHORT_CARTPOLE, "Breakout"])
def test_a_truncation_bootstraps_from_the_observation_it_ended_on(script, env_id, tmp_path, monkeypatch):
    """The environments are played again with the recorded actions; the agent, at learning rate 0, stays the same."""
    args = script.Args(threads=1, learning_rate=0.0, **{**ONE_ROLLOUT, "env_id": env_id, "update_epochs": 1})
    rollout, gae = Recorder(monkeypatch, script, "act"), Recorder(monkeypatch, script, "compute_gae")
    envs = make_envs(env_id, args.num_envs, max_frames=100)
    with open_run(script, tmp_path) as run:
        agent = script.train(args, envs, run)
    next_values, terminations, truncations = gae.calls[0][0][2:5]
    assert 0 < truncations.sum() < truncations.numel() / 10

    actions = [result[0] for _, result in rollout.calls]
    envs.reset(seed=env_seeds(args.seed, args.num_envs))
    for t, action in enumerate(actions):
        next_obs, _, terminated, truncated, infos = envs.step(action.numpy())
        assert np.array_equal(truncated, truncations[t]) and np.array_equal(terminated, terminations[t])
        for n in np.flatnonzero(truncated):
            assert not np.array_equal(next_obs[n], infos["final_obs"][n])
            next_obs[n] = infos["final_obs"][n]
        with torch.inference_mode():
            expected = agent(torch.from_numpy(next_obs).movedim(1, -1))[1]
        assert torch.allclose(next_values[t], expected, atol=1e-5)


@pytest.mark.thesis("normalize")
def test_advantages_are_normalised_within_each_minibatch(script, tmp_path, monkeypatch):
    objective = Recorder(monkeypatch, script, "surrogate")
    train(script, tmp_path, **{**CARTPOLE, "total_timesteps": 128})
    minibatches = torch.stack([given[1] for given, _ in objective.calls])
    assert minibatches.shape == (16, 32)
    assert minibatches.mean(1).abs().max() < 1e-5 and (minibatches.std(1) - 1).abs().max() < 1e-4


def test_a_target_kl_is_held_against_the_mean_over_an_epoch(script, tmp_path, monkeypatch):
    """Of a seed whose last minibatch has another KL than the mean: the targets have the mean alone between them."""
    objective = Recorder(monkeypatch, script, "surrogate")
    arguments = {**CARTPOLE, "total_timesteps": 128, "learning_rate": 0.01}
    for seed in range(1, 21):
        objective.calls.clear()
        train(script, tmp_path / f"far {seed}", seed=seed, **arguments)
        ratios = [given[0] for given, _ in objective.calls[:4]]
        kls = [(ratio - 1 - ratio.log()).mean().item() for ratio in ratios]
        mean, last = np.mean(kls), kls[-1]
        if abs(mean - last) > 0.2 * mean:
            break
    else:
        pytest.fail("no seed of 20 has the two apart")
    for target in (0.9 * mean, 1.1 * mean):
        objective.calls.clear()
        train(script, tmp_path / f"target {target}", target_kl=target, seed=seed, **arguments)
        assert (len(objective.calls) == 4) == (target < mean)


@pytest.mark.thesis("Agent", "orthogonal", "tanh_mlp")
@pytest.mark.parametrize("obs_shape", [(4,), (4, 84, 84)], ids=["flat", "screens"])
def test_a_new_network_is_orthogonal_with_a_nearly_uniform_policy(script, obs_shape):
    """Gain √2 in the hidden layers, 0.01 for the policy and 1 for the value, as in OpenAI's baselines."""
    torch.manual_seed(1)
    agent = script.Agent(obs_shape, 6)
    last = {"actor.weight": 0.01, "actor.4.weight": 0.01, "critic.weight": 1.0, "critic.4.weight": 1.0}
    for name, parameter in agent.named_parameters():
        if name.endswith("bias"):
            assert not parameter.any()
            continue
        weight = parameter.detach().flatten(1)
        short = weight @ weight.T if len(weight) <= weight.shape[1] else weight.T @ weight
        assert torch.allclose(short, last.get(name, 2**0.5) ** 2 * torch.eye(len(short)), atol=1e-4), name
