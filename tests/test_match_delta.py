"""The δ of the product-only objective is where it clips as many samples as PPO."""

import math

import pytest

from benchmark import match_delta


def test_between_the_tried_bounds_the_clip_fraction_is_linear_in_log_delta():
    deltas, fractions = [0.01, 0.1, 1.0], [0.3, 0.2, 0.0]
    assert match_delta.interpolate(deltas, fractions, 0.2) == pytest.approx(0.1)
    assert match_delta.interpolate(deltas, fractions, 0.25) == pytest.approx(0.1 / math.sqrt(10))
    assert match_delta.interpolate(deltas, fractions, 0.05) == pytest.approx(0.1 * 10**0.75)


@pytest.mark.parametrize("wanted", [0.31, -0.01])
def test_beyond_the_tried_bounds_there_is_no_match(wanted):
    assert math.isnan(match_delta.interpolate([0.01, 1.0], [0.3, 0.0], wanted))


@pytest.mark.slow
def test_a_tight_bound_clips_more_than_a_wide_one(capsys):
    """Two iterations on CartPole, whole processes."""
    match_delta.main(games=("CartPole-v1",), deltas=(1e-4, 10.0), iterations=2, jobs=2)
    _, _, row, _, last = capsys.readouterr().out.splitlines()
    game, ppo, tight, wide, matching = (cell.strip() for cell in row.strip("|").split("|"))
    assert game == "CartPole-v1" and float(tight) > float(ppo) >= float(wide)
    assert 1e-4 < float(matching) <= 10 and last.endswith(f"δ = {matching}")
