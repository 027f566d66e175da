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


def test_fractions_that_do_not_fall_give_no_match():
    assert math.isnan(match_delta.interpolate([0.02, 0.04, 0.08], [0.3, 0.1, 0.2], 0.15))
    assert match_delta.interpolate([0.08, 0.02, 0.04], [0.1, 0.3, 0.2], 0.2) == pytest.approx(0.04)  # in any order


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"games": ()}, "--games"),
        ({"deltas": (0.1,)}, "--deltas"),
        ({"deltas": (0.1, -0.1)}, "--deltas"),
        ({"iterations": 0}, "--iterations"),
        ({"jobs": 0}, "--jobs"),
        ({"games": ("Brekout",), "jobs": 1}, "--env-id Brekout"),
    ],
)
def test_what_cannot_work_is_refused_in_one_line(given, said, capsys):
    with pytest.raises(SystemExit) as ended:
        match_delta.main(**given)
    err = capsys.readouterr().err
    assert ended.value.code == 2 and err.startswith(said) and err.count("\n") == 1


def test_a_game_without_a_match_is_said(capsys, monkeypatch):
    fractions = {"ppo_atari.py": 0.2, "0.1": 0.15, "0.2": 0.1}
    find = lambda *flags, steps: next(fractions[flag] for flag in flags if flag in fractions)  # noqa: E731
    monkeypatch.setattr(match_delta, "clip_fraction", find)
    with pytest.raises(SystemExit) as ended:
        match_delta.main(games=("Pong",), deltas=(0.1, 0.2))
    out, err = capsys.readouterr()
    assert ended.value.code == 1 and "| Pong | 0.2000 | 0.1500 | 0.1000 | nan |" in out
    assert err.startswith("Pong: PPO's clip fraction is not between") and err.count("\n") == 1


@pytest.mark.slow
def test_a_tight_bound_clips_more_than_a_wide_one(capsys):
    """Two iterations on CartPole, whole processes."""
    match_delta.main(games=("CartPole-v1",), deltas=(1e-4, 10.0), iterations=2, jobs=2)
    _, _, row, _, last = capsys.readouterr().out.splitlines()
    game, ppo, tight, wide, matching = (cell.strip() for cell in row.strip("|").split("|"))
    assert game == "CartPole-v1" and float(tight) > float(ppo) >= float(wide)
    assert 1e-4 < float(matching) <= 10 and last.endswith(f"δ = {matching}")
