"""The pure functions of the scripts, against brute force, closed forms and numbers worked out by hand."""

import inspect
import math

import numpy as np
import pytest
import torch

import acppo_atari
import ppo_atari


def brute_force_gae(rewards, values, next_values, terminations, truncations, gamma, gae_lambda):
    """The sum of section 2.5, Â_t = Σ_l (γλ)^l δ_{t+l}, cut after the step that ends an episode."""
    num_steps, num_envs = rewards.shape
    advantages = np.zeros((num_steps, num_envs))
    for n in range(num_envs):
        for t in range(num_steps):
            for k in range(t, num_steps):
                bootstrap = 0.0 if terminations[k, n] else gamma * next_values[k, n]
                delta = rewards[k, n] + bootstrap - values[k, n]
                advantages[t, n] += (gamma * gae_lambda) ** (k - t) * delta
                if terminations[k, n] or truncations[k, n]:
                    break
    return advantages


@pytest.mark.thesis("compute_gae")
def test_gae_matches_the_brute_force_sum(each_script):
    random = np.random.default_rng(1)
    shape = (20, 6)
    rewards, values, next_values = random.normal(size=(3, *shape))
    terminations, truncations = random.random((2, *shape)) < 0.15
    assert terminations.any() and truncations.any()
    arrays = rewards, values, next_values, terminations, truncations
    computed = each_script.compute_gae(*map(torch.from_numpy, arrays), gamma=0.9, gae_lambda=0.8)
    assert np.allclose(computed, brute_force_gae(*arrays, gamma=0.9, gae_lambda=0.8), atol=1e-12)


def test_the_clip_range_of_ppo_is_epsilon_whatever_the_advantage():
    assert ppo_atari.clip_range(torch.tensor([-3.0, 0.0, 2.0]), 0.1).tolist() == pytest.approx([0.1] * 3)


def test_the_clip_range_of_acppo_follows_the_formula():
    advantages = torch.tensor([-3.0, 0.0, 1.0, 0.5])
    clip = acppo_atari.clip_range(advantages, 0.16, 2.0)
    assert clip.tolist() == pytest.approx([0.16 / 7, 0.16, 0.16 / 3, 0.08])


def test_the_clip_range_at_c_infinite_is_delta_over_the_advantage():
    advantages = torch.tensor([-4.0, 0.5, 0.0])
    assert acppo_atari.clip_range(advantages, 0.2, math.inf).tolist() == pytest.approx([0.05, 0.4, math.inf])


@pytest.mark.parametrize("c", [0.0, 1.0, math.inf])
def test_no_gradient_flows_through_the_clip_range(c):
    advantages = torch.tensor([1.0, -2.0], requires_grad=True)
    assert not acppo_atari.clip_range(advantages, 0.1, c).requires_grad


def samples(count: int = 4000):
    """Ratios on both sides of 1 and advantages of both signs, some of them 0."""
    generator = torch.Generator().manual_seed(3)
    logratio = 0.5 * torch.randn(count, generator=generator, dtype=torch.float64)
    advantages = torch.randn(count, generator=generator, dtype=torch.float64)
    advantages[:10] = 0.0
    return logratio.exp().requires_grad_(), advantages


def value_and_gradient(objective, ratio):
    return objective.detach(), torch.autograd.grad(objective.sum(), ratio)[0]


def test_the_objective_at_c_infinite_is_the_product_only_one():
    """L^× of section 3.1 plus Â, which has mean 0 and no gradient: value and gradient, sample by sample."""
    ratio, advantages = samples()
    delta = 0.15
    clip = acppo_atari.clip_range(advantages, delta, math.inf)
    value, gradient = value_and_gradient(acppo_atari.surrogate(ratio, advantages, clip), ratio)
    product = (ratio - 1) * advantages
    expected = product.clamp(max=delta) + advantages
    expected_value, expected_gradient = value_and_gradient(expected, ratio)
    assert (product > delta).any() and (product < -delta).any()
    assert torch.allclose(value, expected_value, atol=1e-12)
    assert torch.allclose(gradient, expected_gradient, atol=1e-12)


def test_a_large_c_approaches_the_product_only_objective():
    ratio, advantages = samples()
    delta, c = 0.15, 1e6
    at_infinity = acppo_atari.surrogate(ratio, advantages, acppo_atari.clip_range(advantages, delta, math.inf))
    nearby = acppo_atari.surrogate(ratio, advantages, acppo_atari.clip_range(advantages, c * delta, c))
    assert torch.allclose(nearby, at_infinity, atol=1e-3)


def test_a_policy_that_has_not_moved_gets_the_policy_gradient(each_script):
    """At ρ = 1 it is Â, for PPO and all its kin: they differ in how they brake from there on."""
    ratio, advantages = torch.ones(4, requires_grad=True), torch.tensor([-2.0, -0.5, 0.5, 2.0])
    given = ratio, advantages, torch.tensor([0.05, 0.3, 0.05, 0.3])
    try:
        inspect.signature(each_script.surrogate).bind(*given)
    except TypeError as error:
        pytest.skip(f"its surrogate takes other arguments ({error})")
    (gradient,) = torch.autograd.grad(each_script.surrogate(*given).sum(), ratio)
    assert gradient.tolist() == pytest.approx(advantages.tolist())


@pytest.mark.thesis("surrogate")
def test_the_surrogate_removes_gains_outside_the_range_not_losses(each_script):
    ratio = torch.tensor([1.5, 0.5, 1.5, 0.5, 1.05])
    advantages = torch.tensor([2.0, 2.0, -2.0, -2.0, 2.0])
    clip = torch.full((5,), 0.1)
    expected = [1.1 * 2, 0.5 * 2, 1.5 * -2, 0.9 * -2, 1.05 * 2]
    assert each_script.surrogate(ratio, advantages, clip).tolist() == pytest.approx(expected)


@pytest.mark.thesis("value_loss")
def test_the_value_loss_is_the_larger_of_plain_and_clipped(each_script):
    new_values, values, returns = torch.tensor([1.0, 1.0]), torch.tensor([0.0, 0.0]), torch.tensor([3.0, 0.0])
    assert each_script.value_loss(new_values, values, returns, None).item() == pytest.approx(0.5 * (4 + 1) / 2)
    # Clipped to 0.1: errors 2.9² and 0.1², of which the larger with 2² and 1² counts
    assert each_script.value_loss(new_values, values, returns, 0.1).item() == pytest.approx(0.5 * (2.9**2 + 1) / 2)


def test_the_change_of_the_policy_on_two_states_worked_out_by_hand(each_script):
    before = torch.tensor([[0.5, 0.5], [0.8, 0.2]], dtype=torch.float64)
    after = torch.tensor([[0.6, 0.4], [0.5, 0.5]], dtype=torch.float64)
    actions, advantages = torch.tensor([0, 1]), torch.tensor([2.0, -3.0], dtype=torch.float64)
    change = each_script.policy_change(before.log(), after.log(), actions, advantages)
    log = math.log
    kl_first = 0.5 * log(0.5 / 0.6) + 0.5 * log(0.5 / 0.4)
    kl_second = 0.8 * log(0.8 / 0.5) + 0.2 * log(0.2 / 0.5)
    expected = {
        "kl": (kl_first + kl_second) / 2,
        "old_approx_kl": (log(0.5 / 0.6) + log(0.2 / 0.5)) / 2,
        "approx_kl": ((0.2 - log(1.2)) + (1.5 - log(2.5))) / 2,
        "tv_distance": (0.1 + 0.3) / 2,
        "max_tv_distance": 0.3,
        "max_ratio_advantage": 4.5,  # |(2.5 - 1) · (-3)|
    }
    assert {name: value.item() for name, value in change.items()} == pytest.approx(expected)


def test_a_policy_that_hardly_moves_has_no_kl_below_zero(each_script):
    """Rounding alone would give one."""
    before = torch.randn(1000, 256, 6, generator=torch.Generator().manual_seed(1)).log_softmax(-1)
    after = (before + 1e-7).log_softmax(-1)
    sums = (before.exp() * (before - after)).sum(-1).mean(-1)
    actions, advantages = torch.zeros(256, dtype=torch.int64), torch.zeros(256)
    measured = [each_script.policy_change(*both, actions, advantages)["kl"] for both in zip(before, after)]
    assert sums.min() < 0 and torch.equal(torch.stack(measured), sums.clamp(min=0))
