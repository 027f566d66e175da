"""A patch in examples/ makes a script of one of the two as it is today; `pytest --script` holds it to its promises."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

import acppo_atari
from conftest import PATIENCE, ROOT, TINY_PIXELS, checkpoint_of, reproducible, train
from siblings import ACPPO, PPO, changed_definitions, counts, load, nearer

EXAMPLES = {"spo": (PPO, {"Args", "surrogate"}), "placebo": (ACPPO, {"clip_range", "train"})}  # of what, changed where
EPSILON = 0.2
PIXELS = {"env_id": TINY_PIXELS, "num_envs": 2, "num_steps": 16, "total_timesteps": 64, "threads": 1}


def patch_of(name: str) -> Path:
    return ROOT / "examples" / f"{name}.patch"


def example_in(directory: Path, name: str) -> Path:
    """Makes an example's script in a directory that is no checkout."""
    base, _ = EXAMPLES[name]
    shutil.copy(base, directory)
    outside = {key: value for key, value in os.environ.items() if not key.startswith("GIT_")}
    outside["GIT_CEILING_DIRECTORIES"] = str(directory.parent)  # in a subdirectory of a checkout git applies nothing
    subprocess.run(["git", "apply", str(patch_of(name))], cwd=directory, env=outside, check=True, timeout=PATIENCE)
    assert (directory / base.name).read_bytes() == base.read_bytes()
    return directory / f"{name}_atari.py"


@pytest.fixture(scope="module")
def examples(tmp_path_factory) -> dict[str, ModuleType]:
    return {name: load(example_in(tmp_path_factory.mktemp(name), name)) for name in EXAMPLES}


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_patch_is_small_and_changes_what_its_idea_is(examples, name):
    path, (base, changed) = examples[name].__file__, EXAMPLES[name]
    lines_out, lines_in, _ = counts(base, path)
    assert 0 < lines_out <= 15 and 0 < lines_in <= 30
    assert nearer(path) == base and changed_definitions(path, base) == changed


@pytest.mark.parametrize("advantage", [-3.0, -0.5, 0.5, 3.0])
def test_spos_objective_is_concave_with_its_maximum_at_epsilon(examples, advantage):
    ratio = torch.linspace(0.01, 2, 200, dtype=torch.float64, requires_grad=True)  # steps of 0.01
    advantages = torch.full_like(ratio, advantage)
    spo = examples["spo"]
    objective = spo.surrogate(ratio, advantages, spo.clip_range(advantages, EPSILON))
    (gradient,) = torch.autograd.grad(objective.sum(), ratio)
    best = objective.argmax()
    assert ratio[best].item() == pytest.approx(1 + EPSILON if advantage > 0 else 1 - EPSILON)
    assert gradient[best].item() == pytest.approx(0, abs=1e-12)
    assert ratio[99].item() == 1 and gradient[99].item() == pytest.approx(advantage)
    assert objective[99].item() == pytest.approx(advantage)
    assert (objective.diff().diff() < 0).all() and (gradient.diff() < 0).all()


def test_the_placebos_ranges_are_acppos_dealt_out_anew(examples):
    advantages, dealer = torch.randn(256, generator=torch.Generator().manual_seed(1)), torch.Generator().manual_seed(2)
    ranges = acppo_atari.clip_range(advantages, 0.16, 1.0)
    first, second = (examples["placebo"].clip_range(advantages, 0.16, 1.0, dealer) for _ in range(2))
    for one, other in ((first, ranges), (second, ranges), (first, second)):
        assert torch.equal(one.sort().values, other.sort().values)
        assert (one == other).sum() < 10  # a random permutation of any number leaves one, on average, where it is


def test_the_placebo_trains_as_acppo_bit_for_bit_if_all_ranges_are_equal(examples, tmp_path):
    ends = []
    for script in (acppo_atari, examples["placebo"]):
        run_dir = tmp_path / script.__name__
        logged = reproducible(train(script, run_dir, **PIXELS, c=0, learning_rate=0.01))
        ends.append((logged, [parameter.tolist() for parameter in checkpoint_of(run_dir)["agent"].values()]))
    assert ends[0] == ends[1]


def pytest_on(script: Path, *selection: str) -> subprocess.CompletedProcess:
    """Runs this project's tests on a script elsewhere, from its directory."""
    command = [sys.executable, "-m", "pytest", str(ROOT / "tests"), f"--script={script.name}", "-n0", "-q"]
    command += ["-p", "no:cacheprovider", "--tb=no", *selection]
    return subprocess.run(command, cwd=script.parent, capture_output=True, text=True, timeout=PATIENCE)


CHECKED = "test_mathematics or plain_form or every_logged or other_environments or straight_through or in_one_line"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "own", "left_out"), [("spo", "surrogate", 2), ("placebo", "clip_range", 1)])
def test_an_example_keeps_what_every_sibling_promises_and_its_diff_is_shown(name, own, left_out, tmp_path):
    script = example_in(tmp_path, name)
    ended = pytest_on(script, "-k", CHECKED)
    assert ended.returncode == 0, ended.stdout
    against = f"{script.name} against {EXAMPLES[name][0].name}"
    assert re.search(rf"{against}: \d+ lines out, \d+ in, \d+ hunks", ended.stdout)
    assert re.findall(r"^\+.*\n", patch_of(name).read_text(encoding="utf-8"), re.M)[-1] in ended.stdout
    assert re.search(rf"SKIPPED .*: {script.name} has its own {own}\n", ended.stdout)
    passed, skipped = map(int, re.search(r"\n(\d+) passed, (\d+) skipped", ended.stdout).groups())
    assert passed > 15 and skipped == left_out
