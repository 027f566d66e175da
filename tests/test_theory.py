"""The thesis's bounds on small random MDPs that are solved exactly; `policy_change` measures the distances.

(2.12) and theorem 2.3.2 are printed with s ~ d_π̃ on both sides; the second is s ~ d_π, as the proof of theorem 3.1.1
has it, and the tests follow the proof.
"""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ppo_atari import policy_change


def random_policies(random: np.random.Generator, num_states: int, num_actions: int, sharpness: float, step: float):
    """Returns π(a | s) (S, A), and one that lies `step` of the way from it to an unrelated policy."""
    old, other = random.dirichlet(np.full(num_actions, sharpness), (2, num_states)) + 1e-3
    old, other = (policy / policy.sum(1, keepdims=True) for policy in (old, other))
    return old, (1 - step) * old + step * other


@settings(max_examples=200, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 0.99), st.floats(0.0, 1.0))
def test_the_bounds_hold(seed, gamma, step):
    """Theorems 2.3.2 and 3.1.1 and proposition 2.4.1, and lemma 2.3.1, by which the visitation d is the right one."""
    random = np.random.default_rng(seed)
    num_states, num_actions, sharpness = random.integers(2, 7), random.integers(2, 5), random.choice([0.1, 1.0])
    old, new = random_policies(random, num_states, num_actions, sharpness, step)
    transitions = random.dirichlet(np.full(num_states, sharpness), (num_states, num_actions))  # p(s' | s, a)
    rewards, start = random.normal(size=old.shape), random.dirichlet(np.full(num_states, sharpness))

    def value_and_visitation(policy):
        """V_π (2.2) and d_π (2.9), which sums to 1."""
        stays = np.eye(num_states) - gamma * np.einsum("sa,sap->sp", policy, transitions)
        return np.linalg.solve(stays, (policy * rewards).sum(1)), (1 - gamma) * np.linalg.solve(stays.T, start)

    (value, d_old), (new_value, d_new) = value_and_visitation(old), value_and_visitation(new)
    advantage = rewards + gamma * transitions @ value - value[:, None]  # A_π(s, a) (2.5)
    gained = (new * advantage).sum(1)  # E_{a ~ π̃}[A_π(s, a)]
    error = abs((d_new - d_old) @ gained)
    logs, advantages = (torch.from_numpy(old).log(), torch.from_numpy(new).log()), torch.from_numpy(advantage)
    actions = [torch.full((num_states,), action) for action in range(num_actions)]
    changes = [policy_change(*logs, taken, advantages[:, action]) for action, taken in enumerate(actions)]
    tv_distance = changes[0]["max_tv_distance"].item()
    delta = max(change["max_ratio_advantage"].item() for change in changes)
    tolerance = 1e-9 * (1 + np.abs(advantage).max() / (1 - gamma)) / (1 - gamma)

    assert abs(start @ (new_value - value) - d_new @ gained / (1 - gamma)) <= tolerance, "lemma 2.3.1"
    bound = 4 * gamma * tv_distance**2 * np.abs(advantage).max() / (1 - gamma)
    assert error <= bound + tolerance, "theorem 2.3.2"
    assert error <= delta * np.abs(d_new - d_old).sum() + tolerance, "the tight step of theorem 3.1.1's proof"
    assert error <= 2 * delta + tolerance, "theorem 3.1.1"
    assert tv_distance <= np.abs(new / old - 1).max() / 2 + 1e-9, "proposition 2.4.1"
