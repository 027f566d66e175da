"""A bound matches if the variant clips as many samples, or moves the policy as far, as the other one."""

import math
import subprocess

import pytest

from benchmark import match


@pytest.mark.parametrize(
    ("means", "wanted", "rises", "found"),
    [
        ([0.3, 0.2, 0.0], 0.25, False, 0.1 / math.sqrt(10)),  # linear in the bound's log
        ([0.0, 0.2, 0.3], 0.25, True, 0.1 * math.sqrt(10)),
        ([0.3, 0.2, 0.0], 0.31, False, math.nan),  # beyond the bounds
        ([0.3, 0.2, 0.0], -0.01, False, math.nan),
        ([0.3, 0.1, 0.2], 0.25, False, math.nan),  # noise
    ],
)
def test_interpolation_finds_a_match_if_there_is_one(means, wanted, rises, found):
    assert match.interpolate([0.01, 0.1, 1.0], means, wanted, rises) == pytest.approx(found, nan_ok=True)


@pytest.mark.parametrize("on", ["clipfrac", "kl"])
def test_search_trains_matched_variant_and_the_other_at_each_bound(on, call_main, monkeypatch):
    matched, tried, _, _, rises = match.SEARCHES[on]

    def train(curve, *command):
        assert curve == on and "--bf16" in command and "--stop-at 3072" in " ".join(command)
        if (words := command[: command.index("--env-id")]) == matched or "Qbert" in command:
            return 0.2  # at each bound of Qbert, too: it has no match
        assert words[:-1] == (*tried, "--clip-coef")
        return 0.2 + (1 if rises else -1) * math.log(float(words[-1]) / 0.05)

    monkeypatch.setattr(match, "mean_over_training", train)
    flags = ("--on", on, *"--iterations 3 --bounds 0.06 0.04 --bf16 --games Pong".split())
    status, out, _ = call_main(match, *flags)
    assert status == 0 and out.splitlines()[2].endswith("| 0.0500 |") and out.endswith(" = 0.0500\n")
    status, out, _ = call_main(match, *flags, "Qbert")
    assert status.startswith("Qbert: no match between the tried bounds") and "| Qbert | 0.2 | 0.2 | 0.2 | nan |" in out


def test_one_bound_is_refused_and_a_failing_script_ends_the_search(call_main, monkeypatch, tmp_path):
    assert call_main(match, "--on", "kl", "--bounds", "0.1")[0] == 2
    (tmp_path / "acppo_atari.py").write_text("import sys; sys.exit(3)")
    monkeypatch.setattr(match, "ROOT", tmp_path)
    with pytest.raises(subprocess.CalledProcessError, match="status 3"):
        call_main(match, "--on", "kl")


@pytest.mark.slow
def test_tight_bound_clips_more_and_moves_the_policy_less(call_main):
    for on, bounds in (("clipfrac", ("1e-4", "10")), ("kl", ("1e-4", "0.9"))):
        flags = ("--games", "CartPole-v1", "--iterations", "2", "--jobs", "2")
        status, out, said = call_main(match, "--on", on, *flags, "--bounds", *bounds)
        _, _, tight, wide, bound = (cell.strip() for cell in out.splitlines()[2].strip("|").split("|"))
        assert status == 0 and (float(tight) > float(wide)) == (on == "clipfrac"), said
        assert float(bounds[0]) < float(bound) <= float(bounds[1])
