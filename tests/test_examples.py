"""examples/spo.patch makes spo_atari.py of ppo_atari.py as it is today; `pytest --script` holds it to its promises."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from conftest import PATIENCE, ROOT, SMALL, TINY_PIXELS, flags_of, run_dir_in, scalars
from siblings import PPO, changed_definitions, changes, lines_of, load

PATCH = ROOT / "examples" / "spo.patch"
EPSILON = 0.2


def spo_in(directory: Path) -> Path:
    """Makes spo_atari.py in a directory that is no checkout."""
    shutil.copy(PPO, directory)
    outside = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}
    outside["GIT_CEILING_DIRECTORIES"] = str(directory.parent)  # in a subdirectory of a checkout git applies nothing
    subprocess.run(["git", "apply", str(PATCH)], cwd=directory, env=outside, check=True, timeout=PATIENCE)
    assert (directory / PPO.name).read_bytes() == PPO.read_bytes()
    return directory / "spo_atari.py"


@pytest.fixture(scope="module")
def spo(tmp_path_factory):
    return load(spo_in(tmp_path_factory.mktemp("spo")))


def test_the_patch_is_small_and_changes_the_surrogate(spo):
    hunks = changes(lines_of(PPO), lines_of(spo.__file__))
    assert 0 < sum(i2 - i1 for i1, i2, _, _ in hunks) <= 15
    assert 0 < sum(j2 - j1 for _, _, j1, j2 in hunks) <= 30
    assert changed_definitions(spo.__file__) == {"Args", "surrogate"}
    assert spo.Args().clip_coef == EPSILON


@pytest.mark.parametrize("advantage", [-3.0, -0.5, 0.5, 3.0])
def test_spos_objective_is_concave_with_its_maximum_at_epsilon(spo, advantage):
    ratio = torch.linspace(0.01, 2, 200, dtype=torch.float64, requires_grad=True)  # steps of 0.01
    advantages = torch.full_like(ratio, advantage)
    objective = spo.surrogate(ratio, advantages, spo.clip_range(advantages, EPSILON))
    (gradient,) = torch.autograd.grad(objective.sum(), ratio)
    best = objective.argmax()
    assert ratio[best].item() == pytest.approx(1 + EPSILON if advantage > 0 else 1 - EPSILON)
    assert gradient[best].item() == pytest.approx(0, abs=1e-12)
    assert ratio[99].item() == 1 and gradient[99].item() == pytest.approx(advantage)
    assert objective[99].item() == pytest.approx(advantage)
    assert (objective.diff().diff() < 0).all() and (gradient.diff() < 0).all()


def test_spo_trains_on_pixels(spo, tmp_path, call_main):
    ended = call_main(spo, *flags_of(env_id=TINY_PIXELS, **SMALL, total_timesteps=256, eval_episodes=2))
    assert (ended.status, ended.err) == (0, "") and ended.out.startswith("2 games at step 256: mean ")
    run_dir = run_dir_in(tmp_path / "runs")
    assert "__spo_atari__1__" in run_dir.name
    logged = scalars(run_dir)
    assert [value for _, value in logged["losses/avg_clip_ratio"]] == [pytest.approx(EPSILON)] * 2
    assert all(value > 0 for _, value in logged["losses/kl"])


def pytest_on(script: Path, *selection: str) -> subprocess.CompletedProcess:
    """Runs this project's tests on a script elsewhere, from its directory."""
    command = [sys.executable, "-m", "pytest", str(ROOT / "tests"), f"--script={script.name}", "-n0", "-q"]
    command += ["-p", "no:cacheprovider", "--tb=no", *selection]
    return subprocess.run(command, cwd=script.parent, capture_output=True, text=True, timeout=PATIENCE)


CHECKED = "test_mathematics or every_logged or other_environments or straight_through or in_one_line"


@pytest.mark.slow
def test_spo_keeps_what_every_sibling_promises_and_its_diff_is_shown(tmp_path):
    ended = pytest_on(spo_in(tmp_path), "-k", CHECKED)
    assert ended.returncode == 0, ended.stdout
    assert re.search(r"spo_atari.py against ppo_atari.py: \d+ lines out, \d+ in, \d+ hunks", ended.stdout)
    assert "\n+    clip_coef: PositiveFloat = 0.2\n" in ended.stdout
    assert re.search(r"SKIPPED .*: spo_atari.py has its own surrogate\n", ended.stdout)
    passed, skipped = map(int, re.search(r"\n(\d+) passed, (\d+) skipped", ended.stdout).groups())
    assert passed > 20 and skipped == 1
