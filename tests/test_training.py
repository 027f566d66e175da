"""Whole trainings in this process: what must be equal, what must be zero, and every logged number worked out again."""

import numpy as np
import pytest
import torch

import acppo_atari
import ppo_atari
from conftest import MEASURED_IN_SECONDS, SHORT_CARTPOLE, TINY_PIXELS, scalars, train, values
from wrappers import env_seeds, make_envs

# Small rollouts of each kind: agent steps, environments and steps of a rollout
SMALL = {"num_envs": 4, "num_steps": 32, "total_timesteps": 256}
CARTPOLE = {"env_id": "CartPole-v1", **SMALL}
BREAKOUT = {"env_id": "Breakout", **SMALL}
PIXELS = {"env_id": TINY_PIXELS, **SMALL}


def reproducible(logged: dict) -> dict:
    return {tag: points for tag, points in logged.items() if not tag.startswith(MEASURED_IN_SECONDS)}


@pytest.mark.parametrize("clip_coef", [0.1, 0.16])
@pytest.mark.parametrize("arguments", [CARTPOLE, BREAKOUT], ids=["CartPole", "Breakout"])
def test_acppo_with_c_zero_equals_ppo_bitwise(arguments, clip_coef, tmp_path):
    ppo = train(ppo_atari, tmp_path / "ppo", clip_coef=clip_coef, **arguments)
    acppo = train(acppo_atari, tmp_path / "acppo", clip_coef=clip_coef, c=0.0, **arguments)
    assert reproducible(ppo) == reproducible(acppo)
    assert values(ppo, "losses/clipfrac").size == 2


def test_acppo_with_c_one_does_not_equal_ppo(tmp_path):
    """So that the test above can fail."""
    ppo = train(ppo_atari, tmp_path / "ppo", **CARTPOLE)
    acppo = train(acppo_atari, tmp_path / "acppo", **CARTPOLE)
    assert not np.array_equal(values(ppo, "losses/kl"), values(acppo, "losses/kl"))


@pytest.mark.parametrize("arguments", [CARTPOLE, BREAKOUT], ids=["CartPole", "Breakout"])
def test_the_same_seed_gives_the_same_numbers_and_another_seed_others(script, arguments, tmp_path):
    first, again, other = (
        train(script, tmp_path / name, seed=seed, **arguments)
        for name, seed in (("first", 5), ("again", 5), ("other", 6))
    )
    assert reproducible(first) == reproducible(again)
    assert not np.array_equal(values(first, "losses/value_loss"), values(other, "losses/value_loss"))


@pytest.mark.parametrize("arguments", [CARTPOLE, BREAKOUT], ids=["CartPole", "Breakout"])
def test_with_learning_rate_zero_the_policy_does_not_move(script, arguments, tmp_path):
    logged = train(script, tmp_path, learning_rate=0.0, **arguments)
    for tag in ("kl", "old_approx_kl", "approx_kl", "tv_distance", "max_tv_distance"):
        assert np.abs(values(logged, f"losses/{tag}")).max() < 1e-6
    assert np.abs(values(logged, "losses/clipfrac")).max() == 0


def test_the_average_clip_ratio_lies_between_its_bounds_at_every_iteration(tmp_path):
    epsilon, c = 0.16, 1.0
    logged = train(acppo_atari, tmp_path, clip_coef=epsilon, c=c, **{**CARTPOLE, "total_timesteps": 2560})
    averages = values(logged, "losses/avg_clip_ratio")
    assert len(averages) == 20
    assert (epsilon / (1 + c) < averages).all() and (averages <= epsilon).all()


def test_cartpole_is_learnt(script, tmp_path):
    logged = train(script, tmp_path, env_id="CartPole-v1", total_timesteps=60_000)
    assert values(logged, "charts/mean_return_100")[-1] > 150


def test_the_learning_rate_falls_linearly_and_steps_count_all_environments(script, tmp_path):
    logged = train(script, tmp_path, learning_rate=0.01, **{**CARTPOLE, "total_timesteps": 640})
    steps, rates = zip(*logged["charts/learning_rate"])
    assert steps == (128, 256, 384, 512, 640)
    assert rates == pytest.approx((0.01, 0.008, 0.006, 0.004, 0.002))
    constant = train(script, tmp_path / "constant", learning_rate=0.01, anneal_lr=False, **CARTPOLE)
    assert values(constant, "charts/learning_rate") == pytest.approx([0.01, 0.01])


def test_a_target_kl_skips_the_remaining_epochs(script, tmp_path, monkeypatch):
    calls = []
    surrogate = script.surrogate
    monkeypatch.setattr(script, "surrogate", lambda *given: calls.append(1) or surrogate(*given))
    train(script, tmp_path / "met", target_kl=1e-9, **{**CARTPOLE, "total_timesteps": 128})
    assert len(calls) == 4  # one epoch of four minibatches
    calls.clear()
    train(script, tmp_path / "far", target_kl=1e9, **{**CARTPOLE, "total_timesteps": 128})
    assert len(calls) == 16


class Recorder:
    """Keeps what one of a script's functions was given and what it returned, each time it is called."""

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


@pytest.mark.parametrize("arguments", [CARTPOLE, PIXELS], ids=["CartPole", "pixels"])
def test_every_logged_metric_is_what_it_is_defined_to_be(script, arguments, tmp_path, monkeypatch):
    """One iteration with a large step; its rollout is kept, and each number worked out again in numpy."""
    args = script.Args(threads=1, learning_rate=0.01, **{**arguments, "total_timesteps": 128})
    torch.manual_seed(args.seed)
    envs = make_envs(args.env_id, args.num_envs)
    before = script.Agent(envs.single_observation_space.shape, 2)  # the same first draws as in train

    rollout, gae = Recorder(monkeypatch, script, "act"), Recorder(monkeypatch, script, "compute_gae")
    objective, fit = Recorder(monkeypatch, script, "surrogate"), Recorder(monkeypatch, script, "value_loss")
    after = script.train(args, envs, str(tmp_path))
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
    for (ratio, mb_advantages, _), _ in objective.calls:
        epsilon, c = args.clip_coef, getattr(args, "c", 0.0)
        own_range = epsilon / (1 + c * np.abs(mb_advantages.numpy()))
        clipped.append((np.abs(ratio.numpy() - 1) > own_range).mean())
        ranges.append(np.minimum(own_range, 1).mean())
    expected |= {"clipfrac": np.mean(clipped), "avg_clip_ratio": np.mean(ranges)}

    assert len(objective.calls) == 16 and expected["kl"] > 1e-4 and expected["clipfrac"] > 0.01
    for name, value in expected.items():
        assert logged[f"losses/{name}"] == pytest.approx(value, rel=1e-3, abs=1e-6), name


def test_the_average_clip_ratio_counts_a_range_above_one_as_one(tmp_path):
    logged = train(acppo_atari, tmp_path, c=float("inf"), clip_coef=1e6, **CARTPOLE)
    assert values(logged, "losses/avg_clip_ratio") == pytest.approx([1.0, 1.0])


@pytest.mark.parametrize("env_id", [TINY_PIXELS, SHORT_CARTPOLE, "Breakout"])
def test_a_truncation_bootstraps_from_the_observation_it_ended_on(script, env_id, tmp_path, monkeypatch):
    """The environments are played again with the recorded actions; the agent, at learning rate 0, stays the same."""
    args = script.Args(threads=1, learning_rate=0.0, env_id=env_id, num_envs=4, num_steps=32, total_timesteps=128)
    rollout, gae = Recorder(monkeypatch, script, "act"), Recorder(monkeypatch, script, "compute_gae")
    envs = make_envs(env_id, args.num_envs, max_frames=100)
    agent = script.train(args, envs, str(tmp_path))
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
