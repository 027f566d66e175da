"""The thesis's theory on small random MDPs that are solved exactly.

(2.12) and theorem 2.3.2 are printed with s ~ d_π̃ on both sides; the second is s ~ d_π, as the proof of theorem 3.1.1
has it, and that is what is tested.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st


@dataclass
class MDP:
    transitions: np.ndarray  # p(s' | s, a), (S, A, S)
    rewards: np.ndarray  # r(s, a), (S, A)
    start: np.ndarray  # μ(s), (S,)
    gamma: float

    def value(self, policy: np.ndarray) -> np.ndarray:
        """V_π (S,), by the Bellman equation (2.2); `policy` is π(a | s), (S, A)."""
        return np.linalg.solve(
            np.eye(len(self.start)) - self.gamma * self.moves(policy), (policy * self.rewards).sum(1)
        )

    def moves(self, policy: np.ndarray) -> np.ndarray:
        """p_π(s' | s), (S, S): row s (2.7)."""
        return np.einsum("sa,sap->sp", policy, self.transitions)

    def performance(self, policy: np.ndarray) -> float:
        """J(π) (2.3)."""
        return float(self.start @ self.value(policy))

    def advantage(self, policy: np.ndarray) -> np.ndarray:
        """A_π(s, a), (S, A) (2.5)."""
        value = self.value(policy)
        return self.rewards + self.gamma * self.transitions @ value - value[:, None]

    def visitation(self, policy: np.ndarray) -> np.ndarray:
        """d_π (S,), which sums to 1 (2.9)."""
        states = np.eye(len(self.start))
        return (1 - self.gamma) * np.linalg.solve(states - self.gamma * self.moves(policy).T, self.start)


def random_case(seed: int, gamma: float, step: float) -> tuple[MDP, np.ndarray, np.ndarray]:
    """Returns an MDP, a policy, and one that lies `step` of the way from it to an unrelated policy."""
    random = np.random.default_rng(seed)
    num_states, num_actions = random.integers(2, 7), random.integers(2, 5)
    sharpness = random.choice([0.1, 1.0])  # nearly deterministic, or spread
    mdp = MDP(
        random.dirichlet(np.full(num_states, sharpness), (num_states, num_actions)),
        random.normal(size=(num_states, num_actions)),
        random.dirichlet(np.full(num_states, sharpness)),
        gamma,
    )
    old, other = random.dirichlet(np.full(num_actions, sharpness), (2, num_states)) + 1e-3
    old, other = (policy / policy.sum(1, keepdims=True) for policy in (old, other))
    return mdp, old, (1 - step) * old + step * other


def check_theory(mdp: MDP, old: np.ndarray, new: np.ndarray, visitation) -> None:
    """Asserts lemma 2.3.1, theorems 2.3.2 and 3.1.1 and proposition 2.4.1 for one pair of policies."""
    advantage = mdp.advantage(old)
    gained = (new * advantage).sum(1)  # E_{a ~ π̃}[A_π(s, a)], (S,)
    d_old, d_new = visitation(mdp, old), visitation(mdp, new)
    ratio = new / old
    tv_distance = 0.5 * np.abs(new - old).sum(1).max()
    tolerance = 1e-9 * (1 + np.abs(advantage).max() / (1 - mdp.gamma))

    lemma = mdp.performance(new) - mdp.performance(old) - d_new @ gained / (1 - mdp.gamma)
    assert abs(lemma) <= tolerance / (1 - mdp.gamma), "lemma 2.3.1"
    error = abs((d_new - d_old) @ gained)
    bound = 4 * mdp.gamma * tv_distance**2 * np.abs(advantage).max() / (1 - mdp.gamma)
    assert error <= bound + tolerance, "theorem 2.3.2"
    delta = np.abs((ratio - 1) * advantage).max()
    assert error <= delta * np.abs(d_new - d_old).sum() + tolerance, "the tight step of theorem 3.1.1's proof"
    assert error <= 2 * delta + tolerance, "theorem 3.1.1"
    assert tv_distance <= np.abs(ratio - 1).max() / 2 + 1e-12, "proposition 2.4.1"


cases = st.tuples(st.integers(0, 2**32 - 1), st.floats(0.0, 0.99), st.floats(0.0, 1.0))


@settings(max_examples=300, deadline=None)
@given(cases)
def test_the_lemma_is_an_identity_and_the_bounds_hold(case):
    check_theory(*random_case(*case), visitation=MDP.visitation)


@settings(max_examples=50, deadline=None)
@given(st.tuples(st.integers(0, 2**32 - 1), st.floats(0.5, 0.99), st.floats(0.5, 1.0)))
def test_without_the_factor_one_minus_gamma_the_lemma_fails(case):
    def unnormalised(mdp: MDP, policy: np.ndarray) -> np.ndarray:
        return mdp.visitation(policy) / (1 - mdp.gamma)

    with pytest.raises(AssertionError, match="lemma"):
        check_theory(*random_case(*case), visitation=unnormalised)


def test_without_the_factor_one_minus_gamma_the_bound_of_theorem_311_fails_too():
    """Where π̃ moves the agent between two states that differ only in what an action is worth."""
    ratios = []
    for seed in range(300):
        mdp, old, new = random_case(seed, 0.99, 1.0)
        advantage = mdp.advantage(old)
        shift = (mdp.visitation(new) - mdp.visitation(old)) / (1 - mdp.gamma)
        ratios.append(abs(shift @ (new * advantage).sum(1)) / (2 * np.abs((new / old - 1) * advantage).max()))
    assert max(ratios) > 1
