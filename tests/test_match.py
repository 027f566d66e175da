"""A bound matches if the variant clips as many samples, or moves the policy as far, as the other one."""

import math
import subprocess
import sys

import pytest

from benchmark import match
from conftest import PATIENCE, environment


@pytest.fixture
def call(monkeypatch, capfd):
    """Calls the command in this process: (exit status, stdout, stderr)."""

    def call_main(*flags: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["match.py", *flags])
        try:
            match.main()
            status = 0
        except SystemExit as ended:
            status = ended.code
        return status, *capfd.readouterr()

    return call_main


def test_between_the_tried_bounds_the_mean_is_linear_in_the_bound_s_log():
    bounds, falling = [0.01, 0.1, 1.0], [0.3, 0.2, 0.0]
    assert match.interpolate(bounds, falling, 0.2, rises=False) == pytest.approx(0.1)
    assert match.interpolate(bounds, falling, 0.25, rises=False) == pytest.approx(0.1 / math.sqrt(10))
    assert match.interpolate(bounds, falling, 0.05, rises=False) == pytest.approx(0.1 * 10**0.75)
    assert match.interpolate(bounds, [0, 0.2, 0.3], 0.25, rises=True) == pytest.approx(0.1 * math.sqrt(10))


@pytest.mark.parametrize("wanted", [0.31, -0.01])
def test_beyond_the_tried_bounds_there_is_no_match(wanted):
    assert math.isnan(match.interpolate([0.01, 1.0], [0.3, 0.0], wanted, rises=False))
    assert math.isnan(match.interpolate([0.01, 1.0], [0.0, 0.3], wanted, rises=True))


def test_means_that_do_not_go_one_way_give_no_match():
    assert math.isnan(match.interpolate([0.02, 0.04, 0.08], [0.3, 0.1, 0.2], 0.15, rises=False))
    assert math.isnan(match.interpolate([0.02, 0.04], [0.3, 0.1], 0.2, rises=True))
    assert match.interpolate([0.08, 0.02, 0.04], [0.1, 0.3, 0.2], 0.2, rises=False) == pytest.approx(0.04)  # any order


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--on", "entropy"], "--on entropy"),
        (["--on", "kl", "--games"], "--games"),
        (["--on", "kl", "--bounds", "0.1"], "--bounds"),
        (["--on", "clipfrac", "--bounds", "0.1", "-0.1"], "--bounds"),
        (["--on", "kl", "--iterations", "0"], "--iterations"),
        (["--on", "kl", "--jobs", "0"], "--jobs"),
        (
            ["--on", "kl", "--games", "Pong", "P\udcff"],
            "--games P\ufffd: give it in UTF-8",
        ),  # as Python decodes the byte
    ],
)
def test_what_cannot_work_is_refused_in_one_line(flags, said, call):
    status, _, err = call(*flags)
    assert status == 2 and err.startswith(said) and err.count("\n") == 1


@pytest.mark.parametrize(
    ("on", "matched", "tried"),
    [
        ("clipfrac", ["ppo_atari.py"], ["acppo_atari.py", "--c", "inf"]),
        ("kl", ["acppo_atari.py"], ["ppo_atari.py"]),
    ],
)
def test_each_search_trains_the_matched_one_and_the_other_at_each_bound(on, matched, tried, call, monkeypatch):
    def train(column, *command, steps):
        assert (column, steps) == (on, 3 * 1024) and "--bf16" in command
        words = list(command[: command.index("--env-id")])
        if words == matched:
            return 0.2
        assert words[:-2] == tried and words[-2] == "--clip-coef"
        slope = 1 if on == "kl" else -1
        return 0.2 + slope * math.log(float(words[-1]) / 0.05)

    monkeypatch.setattr(match, "mean_over_training", train)
    status, out, _ = call("--on", on, "--games", "Pong", "--iterations", "3", "--bounds", "0.04", "0.06", "--bf16")
    assert status == 0 and out.splitlines()[2].endswith("| 0.0500 |") and out.endswith(" = 0.0500\n")


def test_a_game_without_a_match_is_said(call, monkeypatch):
    means = {"ppo_atari.py": 0.2, "0.1": 0.15, "0.2": 0.1}
    find = lambda column, *flags, steps: next(means[flag] for flag in flags if flag in means)  # noqa: E731
    monkeypatch.setattr(match, "mean_over_training", find)
    status, out, err = call("--on", "clipfrac", "--games", "Pong", "--bounds", "0.1", "0.2")
    assert status == 1 and "| Pong | 0.2 | 0.15 | 0.1 | nan |" in out
    assert err.startswith("Pong: the clipfrac to match is not between") and err.count("\n") == 1


def test_a_script_that_fails_ends_the_search_with_its_last_line(call, monkeypatch, tmp_path):
    for script in ("ppo_atari.py", "acppo_atari.py"):
        (tmp_path / script).write_text("import sys; sys.exit('first\\nthe reason')")
    monkeypatch.setattr(match, "ROOT", tmp_path)
    assert call("--on", "kl") == (2, "", "the reason\n")


def test_a_table_that_cannot_be_written_is_no_failure(tmp_path):
    program = """
from benchmark import match
match.mean_over_training = lambda column, script, *flags, steps: float(flags[1]) if "--clip-coef" in flags else 0.2
match.main()
"""
    command = [sys.executable, "-c", program, "--on", "kl", "--games", "Pong", "--bounds", "0.1", "0.3"]
    with open("/dev/full", "wb") as full:
        options = {"env": environment(), "stdout": full, "stderr": subprocess.PIPE, "timeout": PATIENCE}
        ended = subprocess.run(command, cwd=tmp_path, **options)
    assert (ended.returncode, ended.stderr) == (0, b"")


@pytest.mark.slow
def test_a_tight_bound_clips_more_than_a_wide_one_and_moves_the_policy_less(call):
    """Two iterations on CartPole, whole processes."""
    for on, bounds in (("clipfrac", ("1e-4", "10")), ("kl", ("1e-4", "0.9"))):
        flags = ("--games", "CartPole-v1", "--iterations", "2", "--jobs", "2")
        status, out, said = call("--on", on, "--bounds", *bounds, *flags)
        game, matched, tight, wide, bound = (cell.strip() for cell in out.splitlines()[2].strip("|").split("|"))
        assert status == 0, said
        assert game == "CartPole-v1" and (float(tight) > float(wide)) == (on == "clipfrac")
        assert float(bounds[0]) < float(bound) <= float(bounds[1]) and out.endswith(f" = {bound}\n")
