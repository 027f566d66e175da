"""The scripts as a user runs them: smoke runs as processes, what they log, and how bad input is refused."""

import math
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import acppo_atari
from conftest import ROOT, SHORT_CARTPOLE, TINY_PIXELS, run_script, scalars
from wrappers import LAYOUT


def documented_tags() -> set[str]:
    """The tags in the README's table of metrics."""
    return set(re.findall(r"^\| `((?:charts|losses|time|eval)/\w+)`", (ROOT / "README.md").read_text(), re.MULTILINE))


@pytest.mark.parametrize("env_id", [SHORT_CARTPOLE, pytest.param(TINY_PIXELS, marks=pytest.mark.slow), "Breakout"])
def test_a_run_logs_every_documented_tag_with_finite_values(script, env_id, tmp_path):
    num_steps = "128" if env_id == "Breakout" else "64"  # long enough for a game of Breakout to end
    run = run_script(
        script,
        "--env-id",
        env_id,
        "--num-envs",
        "4",
        "--num-steps",
        num_steps,
        "--total-timesteps",
        "1024",
        "--eval-episodes",
        "2",
        cwd=tmp_path,
    )
    assert (run.returncode, run.stderr) == (0, "")
    (run_dir,) = (tmp_path / "runs").iterdir()
    exp_name = Path(script.__file__).stem
    assert re.fullmatch(rf"{re.escape(env_id.replace(':', '-'))}__{exp_name}__1__\d+", run_dir.name)
    logged = scalars(run_dir)
    assert logged.keys() == documented_tags()
    charts = [tags for page in LAYOUT.values() for _, tags in page.values()]
    assert len(charts) == 4 and all(set(tags) <= logged.keys() for tags in charts)
    assert all(math.isfinite(value) for points in logged.values() for _, value in points)
    num_iterations = 1024 // (4 * int(num_steps))
    assert len(logged["losses/kl"]) == num_iterations

    reader = EventAccumulator(str(run_dir))
    reader.Reload()
    tags = [tag for tag in reader.Tags()["tensors"] if tag.endswith("/text_summary")]
    texts = {tag: reader.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in tags}
    assert f"|env_id|{env_id}|" in texts["hyperparameters/text_summary"]
    assert "|torch|2.13.0" in texts["provenance/text_summary"]


def test_two_runs_that_start_in_the_same_second_get_two_directories(script, tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 1234567890.5)
    args = script.Args(env_id="ALE/Breakout-v5", log_dir=str(tmp_path / "runs"))
    names = [Path(script.RunDirectory.make(args).path).name for _ in range(3)]
    start = f"ALE-Breakout-v5__{args.exp_name}__1__"
    assert names == [start + second for second in ("1234567890", "1234567891", "1234567892")]


def test_help_explains_every_flag(script, tmp_path):
    run = run_script(script, "--help", cwd=tmp_path)
    assert run.returncode == 0
    flags = [f"--{name.replace('_', '-')}" for name in script.Args.__dataclass_fields__]
    for flag in flags:
        assert re.search(rf"│ {flag}[ ,]", run.stdout), flag
    assert run.stdout.count("(default: ") >= len(flags)


REFUSED = [
    # (flags, the flag that is named, what is said)
    (["--env-id", "Brekout"], "--env-id Brekout", "did you mean Breakout"),
    (["--env-id", "combat"], "--env-id combat", "no mode for one player"),
    (["--env-id", "Breakout-v4"], "--env-id Breakout-v4", "use Breakout"),
    (["--env-id", "Pendulum-v1"], "--env-id Pendulum-v1", "only Discrete actions"),
    (["--env-id", "FrozenLake-v1"], "--env-id FrozenLake-v1", "only flat Box observations"),
    (["--total-timesteps", "1023"], "--total-timesteps 1023", "at least one rollout, num_envs · num_steps = 1024"),
    (["--num-minibatches", "3"], "--num-minibatches 3", "a divisor of num_envs · num_steps = 1024"),
    (["--num-minibatches", "2048"], "--num-minibatches 2048", "a divisor"),
    (["--num-minibatches", "1024"], "--num-minibatches 1024", "or --no-norm-adv"),
    (["--clip-coef", "0"], "--clip-coef 0.0", "above 0"),
    (["--clip-coef", "nan"], "--clip-coef nan", "above 0"),
    (["--clip-coef", "inf"], "--clip-coef inf", "below 1e30"),
    (["--vf-clip-coef", "1e39"], "--vf-clip-coef 1e+39", "below 1e30"),
    (["--num-steps", "1000000000"], "--num-steps 1000000000", "at most 1,000,000 samples"),
    (["--threads", "100000"], "--threads 100000", "a number from 1 to"),
    (["--exp-name", "a" * 300], "--exp-name " + "a" * 300, "up to 100"),
    (["--env-id", "Brek\nout"], "--env-id Brek out", "unknown environment"),
    (["--env-id", "Break out"], "--env-id Break out", "did you mean Breakout"),
    (["--env-id", "HalfCheetah-v4"], "--env-id HalfCheetah-v4", "cannot be built"),
    (["--vf-clip-coef", "-0.1"], "--vf-clip-coef -0.1", "above 0"),
    (["--learning-rate", "0"], "--learning-rate 0.0", "above 0"),
    (["--learning-rate", "inf"], "--learning-rate inf", "below 1e30"),
    (["--max-grad-norm", "0"], "--max-grad-norm 0.0", "above 0"),
    (["--num-envs", "0"], "--num-envs 0", "from 1"),
    (["--num-steps", "-1"], "--num-steps -1", "from 1"),
    (["--update-epochs", "0"], "--update-epochs 0", "from 1"),
    (["--total-timesteps", str(10**17)], f"--total-timesteps {10**17}", "to 10^12"),
    (["--threads", "0"], "--threads 0", "a number from 1 to"),
    (["--ent-coef", "-1"], "--ent-coef -1.0", "from 0"),
    (["--vf-coef", "nan"], "--vf-coef nan", "from 0"),
    (["--gamma", "1.01"], "--gamma 1.01", "from 0 to 1"),
    (["--gamma", "nan"], "--gamma nan", "from 0 to 1"),
    (["--gae-lambda", "-0.1"], "--gae-lambda -0.1", "from 0 to 1"),
    (["--target-kl", "0"], "--target-kl 0.0", "above 0"),
    (["--seed", "-1"], "--seed -1", "from 0"),
    (["--seed", str(2**64)], f"--seed {2**64}", "from 0"),
    (["--exp-name", "a/b"], "--exp-name a/b", "letters, digits"),
    (["--log-dir", "taken"], "--log-dir taken", "cannot be written"),
]


def check_refusal(outcome: tuple, directory: Path, named: str, said: str) -> None:
    status, out, err = outcome
    assert (status, out) == (2, "") and err.count("\n") == 1
    assert err.startswith(f"{named}: ") and said in err
    assert [path.name for path in directory.iterdir()] == ["taken"]


@pytest.fixture
def directory(tmp_path, monkeypatch) -> Path:
    """The working directory of a call, empty but for a file where a log directory might be wanted."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("a file")
    return tmp_path


@pytest.mark.parametrize(("flags", "named", "said"), REFUSED, ids=[" ".join(flags) for flags, _, _ in REFUSED])
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(script, flags, named, said, directory, call_main):
    check_refusal(call_main(script, *flags), directory, named, said)


@pytest.mark.parametrize("c", ["-1", "nan", "-inf", "1e39"])
def test_a_weight_c_that_is_no_weight_is_refused(c, directory, call_main):
    check_refusal(call_main(acppo_atari, f"--c={c}"), directory, f"--c {float(c)}", "0 or above")


def test_a_refusal_is_status_two_and_one_line_from_the_process_too(script, tmp_path):
    run = run_script(script, "--env-id", "Brekout", cwd=tmp_path)
    assert run.returncode == 2
    assert run.stdout == "" and run.stderr == "--env-id Brekout: unknown environment; did you mean Breakout?\n"
    assert list(tmp_path.iterdir()) == []


def test_importing_a_script_leaves_the_environment_alone(script):
    probe = f"import os; before = dict(os.environ); import {script.__name__}; assert os.environ == before"
    subprocess.run([sys.executable, "-c", probe], cwd=ROOT, check=True)
