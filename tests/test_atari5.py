"""The grid on real Ray: one command that is interrupted, called again, fails in part, and loses a worker and a node."""

import dataclasses
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import pytest
import torch

import bookkeeping
import ppo_atari
from benchmark import atari5
from benchmark.atari5 import Args
from conftest import PATIENCE, ROOT, checkpoint_of, scalars

ENDLESS = 10**9  # agent steps: no run ends before its test lets it
GRID = ["--seeds", "1", "--total-timesteps", str(ENDLESS), "--no-figures", "--cores", "2"]  # so two runs at once


def grid_command(out: Path, *flags: str) -> list[str]:
    return [sys.executable, str(ROOT / "benchmark" / "atari5.py"), *GRID, "--out", str(out), *flags]


@pytest.fixture(scope="module")
def start():
    """Starts a grid; one of a test that fails ends after the tests."""
    started = []

    def start_grid(out: Path, *flags: str, sigint=signal.SIG_DFL) -> subprocess.Popen:
        # A suite in the background of a script ignores SIGINT; Ray's workers get the driver's working directory
        own = {"preexec_fn": lambda: signal.signal(signal.SIGINT, sigint), "start_new_session": True, "cwd": out}
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        started.append(subprocess.Popen(grid_command(out, *flags), **own, **pipes))
        return started[-1]

    yield start_grid
    for driver in started:
        driver.terminate()
        driver.communicate()


def has_logged(event_file: Path) -> bool:
    return b"charts/learning_rate" in event_file.read_bytes()  # which the layout of TensorBoard's page does not name


def wait_until_logged(out: Path, runs: int) -> None:
    """Waits until so many runs have finished an iteration."""
    wait_for(lambda: sum(map(has_logged, (out / "training").glob("*/events.*"))) == runs)


def run_dirs(out: Path) -> dict[str, Path]:
    """Returns each run's directory by the run's name; there may be only one."""
    directories = list((out / "training").iterdir())
    by_name = {path.name.rpartition("__")[0]: path for path in directories}
    assert len(by_name) == len(directories)
    return by_name


def steps(run_dir: Path) -> list[int]:
    """Returns the agent steps of the iterations logged."""
    return [step for step, _ in scalars(run_dir).get("charts/learning_rate", [])]


def is_one_curve(run_dir: Path) -> bool:
    """Is each step logged once, up to that of the checkpoint?"""
    return steps(run_dir) == list(range(1024, checkpoint_of(run_dir)["global_step"] + 1, 1024)) != []


def attempts(out: Path, name: str) -> list[str]:
    """Returns the commands that a run was started with."""
    return re.findall(r"^\d{4}-.*?\$ (.*)", (out / "logs" / f"{name}.log").read_text(), re.MULTILINE)


def wait_for(condition) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def interrupt(driver: subprocess.Popen, out: Path) -> str:
    """Ends the grid as Ctrl-C in a terminal does, with each run at its last step; returns its standard error."""
    os.killpg(driver.pid, signal.SIGINT)
    said = driver.communicate(timeout=PATIENCE)[1]
    assert driver.returncode == 130 and not processes(out), said
    assert all(map(is_one_curve, run_dirs(out).values()))
    return said


def processes(out: Path) -> dict[str, list[tuple[int, int]]]:
    """Returns (id, parent's id) of the processes that train, by the name of their run."""
    shown = subprocess.run(["ps", "-ewwo", "pid=,ppid=,args="], capture_output=True, text=True).stdout
    pattern = rf"^ *(\d+) +(\d+) .*/(\w+)_atari\.py .*{out}/training"
    found = {int(pid): (int(parent), name) for pid, parent, name in re.findall(pattern, shown, re.MULTILINE)}
    by_name = defaultdict(list)
    for pid, (parent, name) in found.items():
        if parent not in found:  # else it is about to become another program, such as git
            by_name[f"CartPole-v1__{name}__1"].append((pid, parent))
    return by_name


# ----------------------------------------------------------------------- one grid, interrupted and called again
@pytest.fixture(scope="module")
def grid(tmp_path_factory, start):
    """Interrupts two runs, then takes one of them two iterations further, with a run that cannot start."""
    out = tmp_path_factory.mktemp("grid")
    driver = start(out, "--games", "CartPole-v1")
    wait_until_logged(out, runs=2)
    said = interrupt(driver, out)
    goal = steps(run_dirs(out)["CartPole-v1__ppo__1"])[-1] + 2048
    flags = ("--games", "CartPole-v1", "NoSuch-v0", "--variants", "ppo", "--stop-at", str(goal))
    again = subprocess.run(grid_command(out, *flags), cwd=out, capture_output=True, text=True, timeout=PATIENCE)
    return out, said, goal, again


def test_interrupted_grid_leaves_every_run_at_its_last_step(grid):
    out, said, _, _ = grid
    assert "resume with the same command" in said
    assert set(run_dirs(out)) == {"CartPole-v1__ppo__1", "CartPole-v1__acppo__1"}  # `interrupt` has looked at both


def test_second_call_continues_the_curve_without_gap_or_repetition(grid):
    out, _, goal, _ = grid
    run_dir = run_dirs(out)["CartPole-v1__ppo__1"]
    assert is_one_curve(run_dir) and steps(run_dir)[-1] == goal
    assert f"--resume {run_dir}" in attempts(out, "CartPole-v1__ppo__1")[1]


def test_failing_run_is_tried_twice_and_reported_after_the_rest(grid):
    out, _, _, again = grid
    assert again.returncode == 1 and len(attempts(out, "NoSuch-v0__ppo__1")) == 2
    assert "\nNoSuch-v0__ppo__1: exit status 2: --env-id NoSuch-v0: " in again.stderr
    assert "1 of 2 runs are done" in again.stderr


def test_finished_run_is_skipped_without_a_trace(grid, call_main):
    out, _, goal, _ = grid
    before = {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in out.rglob("*.*")}
    flags = ("--games", "CartPole-v1", "--variants", "ppo", "--stop-at", str(goal))
    assert call_main(atari5, *GRID, "--out", str(out), *flags) == (0, "", f"1 of 1 runs are done, in {out}\n")
    assert before == {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in out.rglob("*.*")}


@pytest.mark.slow
def test_grid_in_the_background_waits_for_its_runs_on_two_signals(tmp_path, start):
    """As launchers send them; an iteration is long enough for a run that is not waited for to be killed in it."""
    variant = f"slow={ROOT / 'ppo_atari.py'} --update-epochs 1000"
    driver = start(tmp_path, "--games", "CartPole-v1", "--variants", variant, sigint=signal.SIG_IGN)
    wait_until_logged(tmp_path, runs=1)
    driver.terminate()
    time.sleep(0.005)
    driver.terminate()
    assert driver.wait(timeout=PATIENCE) == 130 and not processes(tmp_path)
    (log,) = (tmp_path / "logs").iterdir()
    assert "Stopped; " in log.read_text() and all(map(is_one_curve, run_dirs(tmp_path).values()))


# ------------------------------------------------------------------------------------ workers and nodes that are killed
def wait_for_second_start(out: Path, name: str) -> Path:
    """Waits until a second process of a run has finished an iteration; returns its event file."""
    files = []

    def logs_again() -> bool:
        twice = [name for name, found in processes(out).items() if len(found) > 1]
        time.sleep(3 if twice else 0)  # a process that ends lets go of the run some time before it is gone
        assert not twice or all(len(found) == 1 for found in processes(out).values())
        files[:] = sorted(run_dirs(out)[name].glob("events.*"), key=os.path.getmtime)
        return len(files) == 2 and has_logged(files[1])

    wait_for(logs_again)
    return files[1]


@pytest.mark.slow
def test_run_of_a_killed_worker_is_resumed_where_it_was(tmp_path, start):
    driver, name = start(tmp_path, "--games", "CartPole-v1"), "CartPole-v1__ppo__1"
    wait_until_logged(tmp_path, runs=2)
    reached = steps(run_dirs(tmp_path)[name])[-1]
    os.kill(processes(tmp_path)[name][0][1], signal.SIGKILL)
    second = wait_for_second_start(tmp_path, name)
    interrupt(driver, tmp_path)
    assert steps(second)[0] > reached  # no iteration is trained again
    assert len(attempts(tmp_path, name)) == 2 and len(attempts(tmp_path, "CartPole-v1__acppo__1")) == 1


@pytest.mark.slow
def test_run_of_a_killed_node_is_resumed_on_another(tmp_path, start):
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        driver = start(tmp_path, "--games", "CartPole-v1", "--address", cluster.address)
        wait_until_logged(tmp_path, runs=2)
        before = set(processes(tmp_path))
        cluster.remove_node(node, allow_graceful=False)
        # Its run has to wait for another node, for the head's core is taken and no run ends
        wait_for(lambda: len(processes(tmp_path)) == 1)
        (lost,) = before - set(processes(tmp_path))
        cluster.add_node(num_cpus=1)
        wait_for_second_start(tmp_path, lost)
        interrupt(driver, tmp_path)
    finally:
        cluster.shutdown()


# ------------------------------------------------------------------------------------------------------- without Ray
ONE_RUN = "--games Qbert --variants ppo --seeds 1 --total-timesteps 10000".split()


@pytest.fixture
def my_ppo(tmp_path, monkeypatch) -> Path:
    """A script in the current directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(ROOT / "ppo_atari.py", tmp_path / "my_ppo.py"))


def make_run(variant: str, out: Path, game: str = "Qbert", **arguments) -> atari5.Run:
    """Returns a run of 10,000 steps, as the grid makes it."""
    args = Args(out=out, total_timesteps=10_000, **arguments)
    return atari5.make_run(game, atari5.read_variant(variant, 10_000), 1, args)


def saved_run(out: Path, step: int, variant: str = "ppo", **trained) -> atari5.Run:
    """Returns a run of Qbert with a checkpoint of this step, trained with its arguments and script, or others."""
    run = make_run(variant, out)
    of_run = {"env_id": "Qbert", "seed": 1, "exp_name": run.variant.name, "total_timesteps": 10_000}
    trained = {"script": run.variant.code, **bookkeeping.saved_args(ppo_atari.Args(**of_run)), **trained}
    directory = out / "training" / f"{run.name}__1700000000"
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "args.json").write_text(json.dumps({"provenance": {"script": trained.pop("script")}}))
    torch.save({"args": trained, "global_step": step}, directory / "checkpoint.pt")
    return make_run(variant, out)


def test_dry_run_prints_commands_seed_by_seed_and_starts_nothing(tmp_path, call_main):
    flags = ["--games", "phoenix", "Qbert", "--seeds", "1", "2", "2", "--stop-at", "5000", "--bf16", "--dry-run"]
    status, printed, said = call_main(atari5, *flags, "--total-timesteps", "9000", "--out", str(tmp_path / "out"))
    assert (status, said) == (0, "") and not (tmp_path / "out").exists()
    names = [line.split(":")[0] for line in printed.splitlines()]
    assert names == [f"{g}__{v}__{s}" for s in (1, 2) for g in ("Phoenix", "Qbert") for v in ("ppo", "acppo")]
    assert "acppo_atari.py --clip-coef 0.16 --c 1.0 --env-id Phoenix --seed 1" in printed.splitlines()[1]
    assert printed.count("--total-timesteps 9000 --bf16 --threads 1 --eval-episodes 0 --stop-at 5000") == 8


def test_game_of_another_spelling_finds_its_own_runs(tmp_path, call_main):
    saved_run(tmp_path, 1024)
    _, printed, _ = call_main(
        atari5, *ONE_RUN, "--games", "qbert", "QBERT", "--out", str(tmp_path), "--dry-run", "--bf16"
    )
    assert printed.startswith("Qbert__ppo__1: unfinished, step 1,024: ") and printed.count("\n") == 1
    assert f"--resume {tmp_path / 'training' / 'Qbert__ppo__1__1700000000'}" in printed and "--bf16" not in printed


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--variants ppo acpo", "give any of ppo, acppo, "),
        ("--variants mine=nowhere.py", "No such file"),
        ("--variants 'mine=my_ppo.py --clip-coeff 0.2'", "cannot be trained (SystemExit"),  # tyro has said the reason
        ("--variants 'mine=my_ppo.py --seed 2 --env_id=Pong'", "leave --seed, --env_id=Pong to the grid"),
        ("--variants my__ppo=my_ppo.py", "no '__' in the name"),
        ("--variants mine=my_ppo.py 'mine=my_ppo.py --clip-coef 0.2'", "give each variant another name"),
        ("--variants mine=raises.py", "ZeroDivisionError"),
        ("--games Combat", "no mode for one player"),
        (f"--seeds {2**63}", "give a value in 0..2^63-1"),
        ("--cpus-per-run 3 --cores 2", "the grid has 2 cores"),
        ("--address nonsense", "Ray does not start"),
        (f"--out {Args.out} --games Qbert Pong", "is for the thesis's games, variants and length"),
        (f"--out {Args.out} --total-timesteps 20480", "is for the thesis's games, variants and length"),
        (f"--out {Args.out} --variants my=my_ppo.py", "is for the thesis's games, variants and length"),
    ],
)
def test_what_cannot_be_trained_is_refused_in_one_line(flags, said, my_ppo, call_main):
    my_ppo.with_name("raises.py").write_text("1 / 0")
    status, printed, err = call_main(atari5, "--out", "out", *shlex.split(flags))
    *before, last = err.splitlines()
    assert (status, printed) == (2, "") and said in last and last.startswith(flags.split()[0])
    assert not before or "SystemExit" in last


@pytest.mark.parametrize(("source", "status"), [("Qbert__ppo__1__1700000000", 0), ("Qbert__ppo__1__1600000000", 2)])
def test_run_directory_of_another_training_is_refused_at_once(source, status, tmp_path, call_main):
    record = tmp_path / "runs" / saved_run(tmp_path, 1024).name / "run.json"
    record.parent.mkdir(parents=True)
    record.write_text(json.dumps({"source": source}))
    flags = (*ONE_RUN, "--out", str(tmp_path), "--dry-run")
    assert call_main(atari5, *flags)[0] == status and call_main(atari5, *flags, "--no-figures")[0] == 0


@pytest.mark.parametrize(("seeds", "said"), [(("2",), "--seeds 2: this is one seed, number 2\n"), (("1", "2"), "")])
def test_one_seed_is_not_taken_for_a_number_of_seeds(seeds, said, tmp_path, call_main):
    assert call_main(atari5, "--seeds", *seeds, "--out", str(tmp_path), "--dry-run")[2] == said


def test_progress_is_what_a_run_has_said_since_its_start(tmp_path):
    run, queued = (make_run("ppo", tmp_path, game) for game in ("Phoenix", "Qbert"))
    run.log.parent.mkdir()
    now = "step 250,880 of 999,424, 400 SPS, score -12.5, 0:31:11 left"
    run.log.write_text(f"2026 $ python\nstep 1,024 of 999,424, 400 SPS, 0:41:36 left\n{now}\n")
    head = "0 done, 0 failed, 2 unfinished"
    assert atari5.describe([run, queued], began=0) == f"{head}\n  Phoenix__ppo__1: {now}"
    assert atari5.describe([run, queued], began=time.time() + 9) == head  # said in an earlier call
    run.log.write_text(f"{now}\n2026 $ python --resume\n")
    assert atari5.describe([run, queued], began=0) == f"{head}\n  Phoenix__ppo__1: starts"


def test_newest_directory_with_a_checkpoint_is_resumed(tmp_path):
    older = saved_run(tmp_path, 1024).directory()
    newer = older.rename(older.with_name("Qbert__ppo__1__1700000100"))
    newer.with_name("Qbert__ppo__1__1700000200").mkdir()
    assert saved_run(tmp_path, 2048).directory() == newer


def test_run_is_done_at_the_last_whole_rollout_or_at_stop_at(tmp_path):
    assert (saved_run(tmp_path, 8192).state, saved_run(tmp_path, 9216).state) == ("unfinished", "done")  # of 10,000
    saved_run(tmp_path, 2048)
    assert [make_run("ppo", tmp_path, stop_at=stop).state for stop in (2048, 2049)] == ["done", "unfinished"]


# --------------------------------------------------------------------------------------------------- your own script
def test_own_script_is_read_without_a_trace_and_may_import(my_ppo, call_main):
    script = my_ppo.rename(my_ppo.with_name("my ppo"))  # a script may have any name
    script.write_text(script.read_text().replace("import math\n", "import math\nimport helper\n"))
    script.with_name("helper.py").touch()
    variant = "mine='my ppo' --clip-coef 0.2"
    status, printed, _ = call_main(
        atari5, "--games", "Pong", "--out", "out", "--dry-run", "--variants", variant, variant
    )
    assert status == 0 and printed.count(f"{shlex.quote(str(script))} --clip-coef 0.2 --env-id Pong") == 3  # seeds
    assert not list(my_ppo.parent.glob("__pycache__/my*")) and not (my_ppo.parent / "out").exists()


OTHERS = {"gamma": 0.9, "c": 1.0, "env_id": "Pong", "seed": 2, "total_timesteps": 9000, "script": "sha256 other"}


@pytest.mark.parametrize("step", [1024, 9216])
def test_checkpoint_of_other_arguments_or_code_is_refused(step, my_ppo, tmp_path):
    for name, value in {**OTHERS, "bf16": False}.items():
        run = saved_run(tmp_path, step, "mine=my_ppo.py --bf16", **{"bf16": True, name: value})
        assert run.state == "failed" and f"it is trained with {name} {value}, not with" in run.reason
    for flags in ("--bf16", "--clip_coef=1e-1 --norm-adv --target-kl None"):  # that of the grid; another spelling
        run = saved_run(tmp_path, step, f"mine=my_ppo.py {flags}", bf16=True, threads=7)  # threads change no curve
        assert run.state == ("done" if step == 9216 else "unfinished")


def test_script_edited_while_the_grid_runs_starts_no_run(my_ppo, tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", lambda *_, **__: pytest.fail("it was started"))
    run = make_run("mine=my_ppo.py", tmp_path)
    my_ppo.write_text(my_ppo.read_text() + "x = 1\n")
    assert "my_ppo.py has been edited since this call began" in atari5.train(run)


@pytest.mark.parametrize(
    ("variants", "compared"),
    [
        ("mine acppo ppo", ["--baseline", "ppo", "--challenger", "mine", "acppo"]),
        ("product mine", ["--baseline", "product", "--challenger", "mine"]),
        ("mine", []),
    ],
)
def test_report_is_on_all_against_one_if_no_run_failed(variants, compared, my_ppo, tmp_path, call_main, monkeypatch):
    called, make, of_run = [], atari5.make_run, {"state": "done"}
    monkeypatch.setattr(subprocess, "run", lambda words: called.extend(words) or subprocess.CompletedProcess(words, 0))
    monkeypatch.setattr(atari5, "make_run", lambda *words: dataclasses.replace(make(*words), **of_run))
    flags = ("--out", "out", "--games", "Qbert", "--variants", *variants.replace("mine", "mine=my_ppo.py").split())
    assert call_main(atari5, *flags)[0] == 0
    assert called[1:] == [str(ROOT / "benchmark" / "report.py"), "--out", str(tmp_path / "out"), *compared]
    called.clear()
    of_run |= {"state": "failed", "reason": "a reason"}
    assert call_main(atari5, *flags)[0] == 1 and not called
