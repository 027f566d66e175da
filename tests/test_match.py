"""A bound matches if the variant clips as many samples, or moves the policy as far, as the other one."""

import math
import subprocess
import sys

import numpy as np
import pytest

from benchmark import match


@pytest.fixture
def call(monkeypatch, capfd):
    """Calls the command in this process: (status or message, stdout, stderr)."""

    def call_main(*flags: str) -> tuple[int | str, str, str]:
        monkeypatch.setattr(sys, "argv", ["match.py", *flags])
        try:
            return match.main() or 0, *capfd.readouterr()
        except SystemExit as ended:
            return ended.code, *capfd.readouterr()

    return call_main


def test_interpolation_is_linear_in_the_log_of_the_bound():
    find = lambda means, rises: match.interpolate([0.01, 0.1, 1.0], means, 0.25, rises)  # noqa: E731
    assert find([0.3, 0.2, 0.0], rises=False) == pytest.approx(0.1 / math.sqrt(10))
    assert find([0, 0.2, 0.3], rises=True) == pytest.approx(0.1 * math.sqrt(10))


def test_match_is_not_found_beyond_the_bounds_or_among_noise():
    for means, wanted in (([0.3, 0.0], 0.31), ([0.3, 0.0], -0.01), ([0.1, 0.3], 0.2)):
        assert np.isnan(match.interpolate([0.01, 1.0], means, wanted, rises=False))


@pytest.mark.parametrize("flags", ["--on entropy", "--on kl --bounds 0.1", "--on kl --iterations 0"])
def test_impossible_arguments_are_refused(flags, call):
    assert call(*flags.split())[0] == 2


@pytest.mark.parametrize("on", ["clipfrac", "kl"])
def test_search_trains_matched_variant_and_the_other_at_each_bound(on, call, monkeypatch):
    matched, tried, _, _, rises = match.SEARCHES[on]

    def train(curve, *command):
        assert curve == on and "--bf16" in command and "--stop-at 3072" in " ".join(command)
        if (words := command[: command.index("--env-id")]) == matched:
            return 0.2
        assert words[:-1] == (*tried, "--clip-coef")
        return 0.2 + (1 if rises else -1) * math.log(float(words[-1]) / 0.05)

    monkeypatch.setattr(match, "mean_over_training", train)
    status, out, _ = call("--on", on, "--games", "Pong", *"--iterations 3 --bounds 0.06 0.04 --bf16".split())
    assert status == 0 and out.splitlines()[2].endswith("| 0.0500 |") and out.endswith(" = 0.0500\n")


def test_game_without_a_match_is_named(call, monkeypatch):
    monkeypatch.setattr(match, "mean_over_training", lambda on, *command: 0.9 if "--c" in command else 0.2)
    status, out, _ = call("--on", "clipfrac", "--games", "Pong", "--bounds", "0.1", "0.2")
    assert status.startswith("Pong: no match between the tried bounds") and "| Pong | 0.2 | 0.9 | 0.9 | nan |" in out


def test_failing_script_ends_the_search(call, monkeypatch, tmp_path):
    for script in ("ppo_atari.py", "acppo_atari.py"):
        (tmp_path / script).write_text("import sys; sys.exit(3)")
    monkeypatch.setattr(match, "ROOT", tmp_path)
    with pytest.raises(subprocess.CalledProcessError, match="status 3"):
        call("--on", "kl")


@pytest.mark.slow
def test_tight_bound_clips_more_and_moves_the_policy_less(call):
    for on, bounds in (("clipfrac", ("1e-4", "10")), ("kl", ("1e-4", "0.9"))):
        flags = ("--games", "CartPole-v1", "--iterations", "2", "--jobs", "2")
        status, out, said = call("--on", on, *flags, "--bounds", *bounds)
        _, _, tight, wide, bound = (cell.strip() for cell in out.splitlines()[2].strip("|").split("|"))
        assert status == 0 and (float(tight) > float(wide)) == (on == "clipfrac"), said
        assert float(bounds[0]) < float(bound) <= float(bounds[1])
