"""The scripts as a user runs them: smoke runs as processes, their curves, and refusals of bad input."""

import json
import math
import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import acppo_atari
import bookkeeping
from bookkeeping import TENSORBOARD_LAYOUT, check_args, code_hash, git_commit, repeat_command
from conftest import (
    PATIENCE,
    ROOT,
    SCRIPTS,
    SHORT_CARTPOLE,
    SMALL,
    TINY_PIXELS,
    environment,
    flags_of,
    run_dir_in,
    scalars,
)
from siblings import load


def documented_tags() -> set[str]:
    """The tags in the table of curves."""
    rows = re.findall(r"^\| (`\w+/.*?) \|", (ROOT / "docs" / "curves.md").read_text(encoding="utf-8"), re.MULTILINE)
    return {tag for row in rows for tag in re.findall(r"`((?:charts|losses|time|eval)/\w+)`", row)}


def check_a_run_of_two_iterations(script, env_id: str, run_dir: Path) -> None:
    """Asserts that it has logged every documented tag with finite values, and described itself."""
    exp_name = re.escape(Path(script.__file__).stem)
    assert re.fullmatch(rf"{re.escape(env_id.replace(':', '-'))}__{exp_name}__1__\d+", run_dir.name)
    logged = scalars(run_dir)
    assert documented_tags() <= logged.keys()  # a script of one's own may log more
    assert documented_tags() == logged.keys() or script not in SCRIPTS.values()
    charts = [tags for page in TENSORBOARD_LAYOUT.values() for _, tags in page.values()]
    assert len(charts) == 4 and all(set(tags) <= logged.keys() for tags in charts)
    assert all(math.isfinite(value) for points in logged.values() for _, value in points)
    assert len(logged["losses/kl"]) == 2

    reader = EventAccumulator(str(run_dir))
    reader.Reload()
    tags = [tag for tag in reader.Tags()["tensors"] if tag.endswith("/text_summary")]
    texts = {tag: reader.Tensors(tag)[0].tensor_proto.string_val[0].decode() for tag in tags}
    assert f"|env_id|{env_id}|" in texts["hyperparameters/text_summary"]
    assert "|torch|2.13.0" in texts["provenance/text_summary"]


def test_a_run_as_a_process_logs_every_documented_tag(each_script, tmp_path, start):
    """Its rollouts are long enough for a game of Breakout to end; the threads are as many as it takes by itself."""
    sizes = {"num_envs": 2, "num_steps": 160, "total_timesteps": 640, "update_epochs": 1}
    ended = start(each_script, *flags_of(env_id="Breakout", **sizes, eval_episodes=1)).end()
    assert (ended.status, ended.err) == (0, "") and ended.out.startswith("1 games at step 640: mean ")
    check_a_run_of_two_iterations(each_script, "Breakout", run_dir_in(tmp_path / "runs"))


@pytest.mark.parametrize("env_id", [SHORT_CARTPOLE, pytest.param(TINY_PIXELS, marks=pytest.mark.slow)])
def test_other_environments_log_every_documented_tag(script, env_id, tmp_path, call_main):
    ended = call_main(script, *flags_of(env_id=env_id, **SMALL, total_timesteps=256, eval_episodes=2))
    assert (ended.status, ended.err) == (0, "") and ended.out.startswith("2 games at step 256: mean ")
    check_a_run_of_two_iterations(script, env_id, run_dir_in(tmp_path / "runs"))


@pytest.mark.parametrize(
    ("env_id", "name"), [("ALE/Breakout-v5", "ALE-Breakout-v5"), ("name_this_game", "NameThisGame")]
)
def test_two_runs_that_start_in_one_second_get_two_directories(script, env_id, name, tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 1234567890.5)
    args, names = script.Args(env_id=env_id, log_dir=str(tmp_path / "runs")), []
    for _ in range(3):
        names.append(Path(script.RunDirectory.make(args).path).name)
    assert names == [f"{name}__{args.exp_name}__1__{second}" for second in (1234567890, 1234567891, 1234567892)]


def test_the_recorded_command_is_parsed_to_the_same_arguments():
    odd = {"env_id": "a b:c", "log_dir": "-'é\n", "seed": 2**63 - 1, "c": math.inf, "gamma": 1e-7, "norm_adv": False}
    args = acppo_atari.Args(**odd, target_kl=0.5, capture_video=True)
    python, script, *words = shlex.split(repeat_command(args))
    assert (python, script) == ("python", "acppo_atari.py") and tyro.cli(acppo_atari.Args, args=words) == args


def test_lists_tuples_and_paths_of_a_script_are_recorded_and_resumed(script, tmp_path, call_main):
    fields = '    sizes: tuple[PositiveInt, ...] = (3,)\n    files: tuple[Path, ...] = ()\n    data: Path = Path("x")\n'
    text = Path(script.__file__).read_text(encoding="utf-8").replace("    num_envs: ", f"{fields}    num_envs: ", 1)
    (tmp_path / "my_ppo.py").write_text(text, encoding="utf-8")
    mine = load(tmp_path / "my_ppo.py")
    assert call_main(mine, "--sizes", "5", "0").err == "--sizes (5, 0): give a value in 1..10^12\n"
    given = ["--sizes", "5", "6", "7", "--files", "a", "b c", "--data", "d e/f"]
    call_main(mine, *flags_of(env_id=SHORT_CARTPOLE, **SMALL, total_timesteps=256, stop_at=128), *given)
    run_dir = run_dir_in(tmp_path / "runs")
    words = shlex.split(json.loads((run_dir / "args.json").read_text(encoding="utf-8"))["command"])[2:]
    trained = []
    mine.train = lambda args, *_: trained.append((args.sizes, args.files, args.data)) or sys.exit()
    for flags in (words, ["--resume", str(run_dir)]):
        assert call_main(mine, *flags).status == 0
    assert trained == [((5, 6, 7), (Path("a"), Path("b c")), Path("d e/f"))] * 2


def test_the_record_of_a_run_is_strict_json(tmp_path, call_main):
    call_main(acppo_atari, *flags_of(env_id=SHORT_CARTPOLE, **SMALL, total_timesteps=128, eval_episodes=0, c="inf"))
    text = (run_dir_in(tmp_path / "runs") / "args.json").read_text(encoding="utf-8")
    assert json.loads(text, parse_constant=pytest.fail)["args"]["c"] == "inf"


@pytest.mark.parametrize(
    ("flags", "kind", "lines"),
    [(["--bf16"], "AVX2", 1), (["--bf16"], "AVX512", 1), (["--bf16"], "AMX", 0), ([], "AVX2", 0)],
)
def test_bfloat16_that_would_be_emulated_is_warned_of_once(flags, kind, lines, monkeypatch, call_main):
    monkeypatch.setattr(bookkeeping, "processor_kind", lambda: kind)
    size = flags_of(env_id=SHORT_CARTPOLE, **SMALL, total_timesteps=128, eval_episodes=0, no_cuda="")
    ended = call_main(acppo_atari, *(flag for flag in size if flag), *flags)
    assert ended.status == 0 and ended.err.count("\n") == ended.err.count("has no bfloat16 instructions") == lines


def test_the_commit_is_never_another_repositorys(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_DIR", str(tmp_path))  # of another repository, as in a git hook
    commit = git_commit(acppo_atari.__file__)
    assert re.fullmatch(r"[0-9a-f]{40}(-dirty)?", commit) or commit == "unknown"
    if commit != "unknown":
        (tmp_path / "my_ppo.py").write_text("")
        assert git_commit(str(tmp_path / "my_ppo.py")) == commit.removesuffix("-dirty") + "-dirty"
    another = tmp_path / "another"
    outside = {name: value for name, value in environment().items() if not name.startswith("GIT_")}
    subprocess.run(["git", "init", "-q", another], env=outside, check=True)
    assert git_commit(acppo_atari.__file__, str(another)) == "unknown"  # it has no commit
    commit_it = ["-c", "user.name=a", "-c", "user.email=b", "commit", "-q", "--allow-empty", "-m", "one"]
    subprocess.run(["git", "-C", another, *commit_it], env=outside, check=True)
    assert re.fullmatch(r"[0-9a-f]{40}-dirty", git_commit(acppo_atari.__file__, str(another)))
    monkeypatch.setattr(bookkeeping, "__file__", str(another / "bookkeeping.py"))  # a copy that it does not hold
    assert git_commit(acppo_atari.__file__) == "unknown"
    monkeypatch.setenv("PATH", str(tmp_path))
    assert git_commit(acppo_atari.__file__).startswith("unknown (git is not")


def test_a_scripts_hash_is_of_what_it_does(tmp_path):
    script = tmp_path / "script.py"
    texts = ['"""Doc."""\nx = 1  # why\n', '"""Another."""\n\n# because\nx = 1\n', '"""Doc."""\nx = 2  # why\n']
    hashes = [script.write_text(text) and code_hash(script) for text in texts]
    assert hashes[0] == hashes[1] != hashes[2]


@pytest.mark.parametrize(
    ("score", "text"),
    [(-20.26, "-20.3"), (12345.67, "12345.7"), (9.876, "9.88"), (0, "0"), (0.01234, "0.0123"), (1e-5, "1e-05")],
)
def test_scores_of_every_size_show_three_digits(score, text):
    assert bookkeeping.rounded(score) == text


REFUSED = [
    # (flags, the flag that is named, the advice)
    (["--env-id", "Brekout"], "--env-id Brekout", "did you mean Breakout"),
    (["--env-id", "Brek\nout"], "--env-id Brek out", "Malformed environment ID"),
    (["--env-id", "Pendulum-v1"], "--env-id Pendulum-v1", "only Discrete actions"),
    (["--gamma", "1.01"], "--gamma 1.01", "give a value in 0..1"),
    (["--log-dir", "taken"], "--log-dir taken", "cannot be written"),
]


@pytest.mark.parametrize(("flags", "named", "said"), REFUSED, ids=[" ".join(flags) for flags, _, _ in REFUSED])
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(script, flags, named, said, tmp_path, call_main):
    (tmp_path / "taken").write_text("a file")
    status, out, err = call_main(script, *flags)
    assert (status, out) == (2, "") and err.count("\n") == 1
    assert err.startswith(f"{named}: ") and said in err
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


NAN, INF = math.nan, math.inf
BOUNDS = [
    # (arguments, refused values, the advice, accepted values)
    ("total_timesteps num_envs num_steps num_minibatches update_epochs", [0, -1, 10**12 + 1], "1..10^12", []),
    ("clip_coef vf_clip_coef learning_rate max_grad_norm", [0.0, -0.1, NAN, INF, 1e39], "0<x<1e30", [1e-9, 1e29]),
    ("ent_coef vf_coef", [-0.1, NAN, INF, 1e39], "0<=x<1e30", [0.0, 1e29]),
    ("c checkpoint_minutes", [-0.1, NAN, -INF, 1e39], "0<=x<1e30|inf", [0.0, INF]),
    ("gamma gae_lambda", [-0.1, 1.01, NAN], "0..1", [0.0, 1.0]),
    ("target_kl", [0.0, -0.1, NAN], "0<x<1e30", [1e-9, None]),
    ("stop_at", [0, -1], "1..10^12", [1, None]),
    ("seed eval_episodes", [-1, 2**63], "0..2^63-1", [0, 2**63 - 1]),
    ("threads", [0, -1, 100_000], "1..1024", [1]),
    ("exp_name", ["", "a/b", "a b", "a" * 101], "[A-Za-z0-9_.-]{1,100}", ["a", "A-1_b.c"]),
]
ALL_BOUNDS = [(name, *bounds) for names, *bounds in BOUNDS for name in names.split()]


@pytest.mark.parametrize(("name", "bad", "said", "good"), ALL_BOUNDS, ids=[name for name, *_ in ALL_BOUNDS])
def test_an_argument_outside_its_bounds_is_refused_by_name(name, bad, said, good, capfd):
    for value in bad:
        with pytest.raises(SystemExit) as ended:
            check_args(acppo_atari.Args(**{name: value}))
        line = capfd.readouterr().err
        assert ended.value.code == 2 and line.startswith(f"--{name.replace('_', '-')} {value}: ") and said in line
    for value in good:
        check_args(acppo_atari.Args(**{name: value}))


SIZES = {"num_envs": 8, "num_steps": 128, "num_minibatches": 4, "norm_adv": True}  # a rollout of 1024 samples


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"total_timesteps": 1023}, "--total-timesteps 1023: give at least one rollout, num_envs · num_steps = 1024"),
        ({"num_minibatches": 3}, "--num-minibatches 3: give a divisor of num_envs · num_steps = 1024"),
        ({"num_minibatches": 1024}, "--num-minibatches 1024: give fewer, or --no-norm-adv"),
        ({"num_steps": 10**9, "total_timesteps": 10**12}, "give a rollout of at most 1,000,000 samples"),
        ({"evaluate": "runs/a", "resume": "runs/b"}, "--evaluate runs/a: give either this or --resume"),
        ({"evaluate": "runs/a", "eval_episodes": 0}, "--evaluate runs/a: give --eval-episodes above 0, too"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(script, arguments, said, capfd):
    with pytest.raises(SystemExit) as ended:
        check_args(script.Args(**SIZES | arguments))
    assert ended.value.code == 2 and said in capfd.readouterr().err


def test_importing_a_script_changes_nothing_in_its_importer():
    """Neither variables nor the treatment of denormal numbers, which a script that trains flushes to 0."""
    probe = """
import os
before = dict(os.environ)
import ppo_atari, acppo_atari, torch
assert os.environ == before
def denormals():
    return (torch.full((1 << 20,), 2.0**-126) * 0.5).count_nonzero().item()  # on all threads
assert denormals() == 1 << 20
"""
    training = "import bookkeeping; bookkeeping.tune_process(); import torch; torch.set_num_threads(2)\n"
    training += probe[probe.index("def") : probe.index("assert denormals")] + "assert denormals() == 0"
    for text in (probe, training):
        subprocess.run([sys.executable, "-c", text], cwd=ROOT, check=True, timeout=PATIENCE)
