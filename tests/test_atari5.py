"""The grid on real Ray: one command that is interrupted, called again, fails in part, and loses a worker and a node."""

import fcntl
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
from benchmark import atari5
from benchmark.atari5 import Args, Progress
from conftest import PATIENCE, ROOT, SCRIPTS, environment, scalars

ENDLESS = 10**9  # agent steps: no run ends before its test lets it
GUARD = 300  # seconds, after which something hangs; no outcome depends on it
GRID = ["--seeds", "1", "--total-timesteps", str(ENDLESS), "--no-figures"]


def grid_command(out: Path, *flags: str) -> list[str]:
    cores = [] if "--address" in flags else ["--cores", "2"]  # two runs at once, however many there are
    return [sys.executable, str(ROOT / "benchmark" / "atari5.py"), *GRID, "--out", str(out), *cores, *flags]


def make_run(game: str, variant: str, total_timesteps: int = 5_000_000) -> atari5.Run:
    return atari5.Run(game, atari5.read_variant(variant, total_timesteps), seed=1)


STARTED = []


@pytest.fixture(scope="module", autouse=True)
def no_grid_outlives_the_tests():
    """Of a test that fails, too."""
    yield
    for driver in STARTED:
        if driver.poll() is None:
            driver.terminate()
            driver.communicate()


def start(out: Path, *flags: str, sigint=signal.SIG_DFL) -> subprocess.Popen:
    # SIGINT: a suite that runs in the background of a script ignores it, as would all that it starts.
    # cwd: outside the repository, because Ray's workers get the driver's.
    own = {"preexec_fn": lambda: signal.signal(signal.SIGINT, sigint), "start_new_session": True, "cwd": out}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    STARTED.append(subprocess.Popen(grid_command(out, *flags), **own, **pipes))
    return STARTED[-1]


def has_logged(event_file: Path) -> bool:
    return b"charts/learning_rate" in event_file.read_bytes()  # which the layout of TensorBoard's page does not name


def both_log(out: Path) -> bool:
    """Have two runs finished an iteration?"""
    return sum(map(has_logged, (out / "runs").glob("*/events.*"))) == 2


def run_dirs(out: Path) -> dict[str, Path]:
    """Returns each run's directory by the run's name; there may be one alone."""
    directories = {path.name.rpartition("__")[0]: path for path in (out / "runs").iterdir()}
    assert len(directories) == len(list((out / "runs").iterdir()))
    return directories


def global_step(run_dir: Path) -> int:
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)["global_step"]


def steps(run_dir: Path) -> list[int]:
    """Agent steps of the iterations logged."""
    return [step for step, _ in scalars(run_dir).get("charts/learning_rate", [])]


def is_one_curve(run_dir: Path) -> bool:
    """Is each step logged once, up to that of the checkpoint?"""
    return steps(run_dir) == list(range(1024, global_step(run_dir) + 1, 1024)) != []


def attempts(out: Path, name: str) -> list[str]:
    """Returns the commands that a run was started with."""
    return re.findall(r"^\d{4}-.*?\$ (.*)", (out / "logs" / f"{name}.log").read_text(), re.MULTILINE)


def wait_for(condition) -> None:
    deadline = time.monotonic() + GUARD
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def interrupt(driver: subprocess.Popen) -> tuple[int, str]:
    """Ends the grid as Ctrl-C in a terminal does; returns its status and standard error."""
    os.killpg(driver.pid, signal.SIGINT)
    said = driver.communicate(timeout=GUARD)[1]
    return driver.returncode, said


def processes(out: Path) -> dict[str, list[int]]:
    """Returns the processes that train, by the name of their run."""
    found, parents = {}, {}
    for process in Path("/proc").glob("[0-9]*"):
        try:
            words = (process / "cmdline").read_bytes().decode().split("\0")
            parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
        except OSError:  # it has just ended
            continue
        flags, pid = dict(zip(words, words[1:])), int(process.name)
        if flags.get("--resume", "").startswith(str(out)):
            found[pid], parents[pid] = Path(flags["--resume"]).name.rpartition("__")[0], parent
        elif flags.get("--log-dir") == str(out / "runs"):
            found[pid], parents[pid] = f"{flags['--env-id']}__{flags['--exp-name']}__{flags['--seed']}", parent
    by_name = defaultdict(list)
    for pid, name in found.items():
        if parents[pid] not in found:  # else it is about to become another program, such as git
            by_name[name].append(pid)
    return by_name


# ------------------------------------------------------------------------------- one grid, interrupted and gone on with
@pytest.fixture(scope="module")
def cluster():
    """The address of a Ray cluster with two cores, however many there are. To start one takes seconds."""
    from ray.cluster_utils import Cluster

    cores = {"num_cpus": 2, "object_store_memory": 100_000_000, "include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=cores)
    yield cluster.address
    cluster.shutdown()


@pytest.fixture(scope="module")
def grid(tmp_path_factory, cluster):
    """Interrupts two runs, then takes one of them two iterations further, beside a game that does not exist."""
    out = tmp_path_factory.mktemp("grid")
    driver = start(out, "--games", "CartPole-v1", "--address", cluster)
    wait_for(lambda: both_log(out))
    status, said = interrupt(driver)
    interrupted = {name: (global_step(path), steps(path)) for name, path in run_dirs(out).items()}
    left = processes(out)
    goal = interrupted["CartPole-v1__ppo__1"][0] + 2048
    flags = ("--games", "CartPole-v1", "Brekout", "--variants", "ppo", "--stop-at", str(goal), "--address", cluster)
    again = subprocess.run(grid_command(out, *flags), cwd=out, capture_output=True, text=True, timeout=GUARD)
    return out, (status, said, interrupted, left), goal, again


@pytest.fixture
def call(monkeypatch, capfd):
    """Calls the grid's `main` in this process, if it starts no run: (exit status, stdout, stderr)."""

    def call_main(*flags: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["atari5.py", *flags])
        with pytest.raises(SystemExit) as ended:
            atari5.main()
        return ended.value.code, *capfd.readouterr()

    return call_main


def finished(grid) -> list[str]:
    """Returns the flags of a grid whose one run is finished."""
    out, _, goal, _ = grid
    return [*GRID, "--out", str(out), "--games", "CartPole-v1", "--variants", "ppo", "--stop-at", str(goal)]


def test_an_interrupted_grid_leaves_every_run_at_a_checkpoint_of_its_last_step(grid):
    _, (status, said, interrupted, left), _, _ = grid
    assert status == 130 and "go on with the same command" in said
    assert set(interrupted) == {"CartPole-v1__ppo__1", "CartPole-v1__acppo__1"} and not left
    for saved, logged in interrupted.values():
        assert logged == list(range(1024, saved + 1, 1024)) != []


def test_called_again_it_finishes_the_curve_without_a_gap_or_a_repetition(grid):
    out, _, goal, _ = grid
    run_dir = run_dirs(out)["CartPole-v1__ppo__1"]
    assert is_one_curve(run_dir) and global_step(run_dir) == goal
    first, again = attempts(out, "CartPole-v1__ppo__1")
    assert "--resume" not in first and f"--resume {run_dir}" in again


def test_a_run_that_always_fails_is_tried_twice_and_reported_while_the_rest_finishes(grid):
    out, _, _, again = grid
    assert again.returncode == 1 and len(attempts(out, "Brekout__ppo__1")) == 2
    # A grid that takes more than a minute says how far it is, too
    (report,) = (line for line in again.stderr.splitlines() if line.startswith("Brekout__ppo__1: "))
    assert report.startswith("Brekout__ppo__1: exit status 2: ")
    assert "1 of 2 runs are done" in again.stderr


def test_finished_runs_are_skipped_without_a_trace(grid, call):
    out = grid[0]
    before = {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in out.rglob("*")}
    assert call(*finished(grid)) == (0, "", f"1 of 1 runs are done, in {out}\n")
    assert before == {path: (path.stat().st_mtime_ns, path.stat().st_size) for path in out.rglob("*")}


def test_with_figures_it_ends_in_those_of_its_runs_whatever_the_locale_and_matplotlib_s_backend(
    grid, call, monkeypatch
):
    for name, value in (("LC_ALL", "C"), ("PYTHONUTF8", "0"), ("PYTHONCOERCECLOCALE", "0"), ("MPLBACKEND", "none")):
        monkeypatch.setenv(name, value)
    out = grid[0]
    status, _, said = call(*finished(grid), "--figures")
    assert (status, said) == (0, f"1 of 1 runs are done, in {out}\n")
    made = out / "figures" / "beginnings"
    assert len(list(made.iterdir())) == len(list(made.glob("*.png"))) + len(list(made.glob("*.svg"))) == 10
    results = (out / "README.md").read_text(encoding="utf-8")
    assert "2 runs (variants acppo, ppo; games CartPole-v1; seeds 1)" in results and "All in float32." in results


def test_a_run_that_another_call_is_training_is_left_to_it(tmp_path, monkeypatch):
    monkeypatch.setattr(atari5, "LOCK_SECONDS", 0)
    run, args = make_run("CartPole-v1", "ppo"), Args(out=tmp_path)
    (tmp_path / "logs").mkdir()
    with run.log(args).open("ab") as log:
        fcntl.flock(log, fcntl.LOCK_EX)
        assert "another process is training it" in atari5.train(run, args, None)
    assert run.log(args).read_text() == ""


def test_a_checkpoint_of_other_arguments_is_reported_and_not_gone_on_with(grid, call):
    out = grid[0]
    flags = ("--games", "CartPole-v1", "--total-timesteps", str(2 * ENDLESS), "--dry-run")
    status, said, _ = call(*GRID, "--out", str(out), *flags)
    assert status == 1 and said.count(f"--total-timesteps {ENDLESS}, not with {2 * ENDLESS}") == 2
    for variant, difference in (("ppo", "--clip-coef 0.1, not with 0.16"), ("acppo", "--c 1.0, not with None")):
        run_dir = run_dirs(out)[f"CartPole-v1__{variant}__1"]
        renamed = run_dir.rename(run_dir.with_name(run_dir.name.replace(variant, "ppo-wide")))
        wide = make_run("CartPole-v1", "ppo-wide", ENDLESS)
        wide.look(Args(out=out, total_timesteps=ENDLESS))
        renamed.rename(run_dir)
        assert wide.state == "failed" and difference in wide.reason


@pytest.mark.slow
def test_a_grid_in_the_background_of_a_script_ends_on_sigterm(tmp_path):
    """There, as after `nohup … &`, SIGINT is ignored by all that the shell starts."""
    driver = start(tmp_path, "--games", "CartPole-v1", sigint=signal.SIG_IGN)
    wait_for(lambda: both_log(tmp_path))
    driver.terminate()
    assert driver.wait(timeout=GUARD) == 130 and not processes(tmp_path)
    assert all(is_one_curve(path) for path in run_dirs(tmp_path).values())


@pytest.mark.slow
def test_runs_are_waited_for_if_a_signal_comes_twice(tmp_path):
    """As launchers send it. An iteration takes long enough for a run that is not waited for to be killed in it."""
    variant = f"slow={ROOT / 'ppo_atari.py'} --update-epochs 1000"
    driver = start(tmp_path, "--games", "CartPole-v1", "--variants", variant)
    wait_for(lambda: any(map(has_logged, (tmp_path / "runs").glob("*/events.*"))))
    driver.terminate()
    time.sleep(0.005)
    driver.send_signal(signal.SIGINT)
    assert driver.wait(timeout=GUARD) == 130
    (log,) = (tmp_path / "logs").iterdir()
    assert "Stopped; go on with" in log.read_text()


# ------------------------------------------------------------------------------------------------------- without Ray
def test_dry_run_prints_the_commands_seed_by_seed_and_starts_nothing(tmp_path, call):
    flags = ["--games", "Phoenix", "Qbert", "--seeds", "1", "2", "2", "--stop-at", "5000", "--bf16", "--dry-run"]
    status, printed, said = call(*flags, "--total-timesteps", "9000", "--out", str(tmp_path / "out"))
    assert (status, said) == (0, "") and not (tmp_path / "out").exists()
    names = [line.split(":")[0] for line in printed.splitlines()]
    assert names == [f"{g}__{v}__{s}" for s in (1, 2) for g in ("Phoenix", "Qbert") for v in ("ppo", "acppo")]
    assert "acppo_atari.py --clip-coef 0.16 --c 1.0 --env-id Phoenix --seed 1" in printed.splitlines()[1]
    assert printed.count("--total-timesteps 9000 --threads 1 --stop-at 5000 --bf16") == 8


def test_a_run_goes_on_with_the_arithmetic_that_it_began_with(tmp_path):
    run, args = make_run("Qbert", "ppo"), Args(out=tmp_path, bf16=True)
    assert "--bf16" in run.command(args) and "--bf16" not in run.command(Args(out=tmp_path))
    (tmp_path / "runs" / "Qbert__ppo__1__1700000000").mkdir(parents=True)
    (tmp_path / "runs" / "Qbert__ppo__1__1700000000" / "checkpoint.pt").touch()
    assert "--resume" in run.command(args) and "--bf16" not in run.command(args)


@pytest.mark.parametrize(
    "flags",
    [
        ["--variants", "ppo", "acpo"],
        ["--games"],
        ["--games", "../Qbert"],
        ["--seeds", "-1"],
        ["--total-timesteps", "0"],
        ["--stop-at", "-5"],
        ["--cores", "0"],
        ["--cores", "2", "--address", "auto"],
        ["--cpus-per-run", "3", "--cores", "2"],
        ["--cpus-per-run", "10000"],
        ["--out", "/proc/nothing"],
        ["--out", "/dev/null"],
        ["--out", "o\udcff"],  # a byte that is no UTF-8, as Python decodes it
        ["--games", "o\udcff"],
        ["--games", "Q" * 300],
        ["--address", "127.0.0.1:1"],
        ["--address", "nonsense"],
    ],
    ids=" ".join,
)
def test_what_cannot_work_is_refused_in_one_line(flags, call):
    status, _, said = call(*flags)
    assert status == 2 and said.count("\n") == 1 and said.startswith(flags[0])


def test_nothing_that_only_posix_has_is_needed_to_import_a_program(tmp_path):
    """What another system lacks is taken away: modules, signals, functions of `os`, and the process as a library."""
    probe = """
import ctypes, importlib, os, pathlib, signal, sys
import ale_py, gymnasium, matplotlib.figure, pandas, tensorboard.backend.event_processing.event_accumulator, torch
sys.modules |= dict.fromkeys(("fcntl", "resource", "pwd", "grp", "termios"))
for module, names in ((os, "sched_getaffinity getuid fchmod wait4 getpgid killpg setsid"), (signal, "SIGHUP")):
    for name in names.split():
        delattr(module, name)
ctypes.CDLL = None
for path in pathlib.Path(sys.argv[1]).glob("*.py"):
    try:
        importlib.import_module(f"benchmark.{path.stem}")
    except ModuleNotFoundError as error:
        if error.name != "stable_baselines3":
            raise
    print(path.stem)
"""
    command = [sys.executable, "-c", probe, str(ROOT / "benchmark")]
    ended = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, timeout=PATIENCE)
    assert ended.returncode == 0 and "atari5" in ended.stdout.split(), ended.stderr


@pytest.mark.parametrize(
    "flags",
    [
        ["--games", "Qbert", "Pong"],
        ["--total-timesteps", "20480"],
        ["--games", "Pong-v5"],
        ["--variants", "ppo", f"mine={ROOT / 'ppo_atari.py'}"],
    ],
)
def test_another_grid_than_the_thesis_s_takes_a_directory_of_its_own(flags, call):
    status, _, said = call(*flags)
    assert status == 2 and said.startswith("--out ") and "the thesis's games, variants and length" in said


def test_a_missing_package_is_named_before_anything_runs(call, monkeypatch):
    monkeypatch.setattr(atari5.importlib.util, "find_spec", lambda name: None)
    assert call() == (2, "", "ray: is not installed; pip install -e '.[benchmark]'\n")


def test_a_grid_takes_the_cores_that_it_is_given(tmp_path, call, monkeypatch):
    import ray

    def refuse_to_start(*_, num_cpus: int, **__):
        raise ValueError(f"asked for {num_cpus}")

    monkeypatch.setattr(ray, "init", refuse_to_start)
    flags = ("--games", "Qbert", "--out", str(tmp_path))
    status, _, said = call(*flags, "--cores", "7", "--cpus-per-run", "5")
    assert status == 2 and said.startswith(
        "--address local: Ray does not start (asked for 7); set RAY_TMPDIR or TMPDIR"
    )
    assert f"asked for {len(os.sched_getaffinity(0))})" in call(*flags)[2]


@pytest.mark.parametrize(
    ("error", "reason"),
    [(Exception("node timed out\nand 19 lines"), "node timed out"), (OSError("AF_UNIX path"), "AF_UNIX path")]
    + [(TimeoutError(), "TimeoutError()")],
)
def test_a_ray_that_does_not_start_is_reported_in_one_line(error, reason, tmp_path, call, monkeypatch):
    import ray

    def refuse_to_start(*_, **__):
        raise error

    monkeypatch.setattr(ray, "init", refuse_to_start)
    status, _, said = call("--games", "Qbert", "--out", str(tmp_path))
    assert status == 2 and said.count("\n") == 1 and f"Ray does not start ({reason}); set RAY_TMPDIR" in said


def test_a_second_signal_interrupts_only_from_one_second_on(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    interrupt = atari5.Interrupt()

    def interrupts(seconds: float) -> bool:
        clock[0] = 100 + seconds
        try:
            interrupt.note(signal.SIGTERM, None)
        except KeyboardInterrupt:
            return True
        return False

    assert [interrupts(seconds) for seconds in (0, 0.003, 0.9, 1, 1.5)] == [True, False, False, True, False]


def test_an_interrupted_directory_without_a_checkpoint_does_not_count(tmp_path):
    (tmp_path / "runs" / "Qbert__ppo__1__1700000000").mkdir(parents=True)
    run = make_run("Qbert", "ppo")
    run.look(Args(out=tmp_path))
    assert run.state == "queued" and "--resume" not in run.command(Args(out=tmp_path))


def test_the_table_shows_percent_score_and_time_left_from_the_logs(tmp_path):
    args = Args(out=tmp_path, total_timesteps=10_000_000, stop_at=1_000_000)
    runs = [make_run(game, "ppo") for game in ("Phoenix", "Qbert", "Pong")]
    runs[2].state = "failed"
    (tmp_path / "logs").mkdir()
    runs[0].log(args).write_text(
        "$ python\nstep 1,024 of 10,000,000, 500 SPS, 5:33:19 left\n"
        "step 250,880 of 10,000,000, 400 SPS, score -12.5, 6:46:13 left\n"
    )
    header, *rows = Progress(runs, args).table()
    assert header == "3 runs: 0 done, 1 running, 1 queued, 1 failed, 1:12:53 left"  # 1,749,120 steps at 400 a second
    assert [" ".join(row.split()) for row in rows] == ["Phoenix ppo seed 1 25% score -12.5", "Pong ppo seed 1 failed"]
    os.utime(runs[0].log(args), (1, 1))  # its node has died
    assert Progress(runs, args).table()[0] == "3 runs: 0 done, 0 running, 2 queued, 1 failed"
    # What an earlier call has left in the log is not taken for this one's
    runs[0].look(args)
    with runs[0].log(args).open("a") as log:
        log.write("$ python --resume\n")
    assert " ".join(Progress(runs, args).table()[1].split()) == "Phoenix ppo seed 1 0%"


@pytest.mark.parametrize("size", [(40, 24), (200, 3), (0, 0), None], ids=str)
def test_the_table_in_a_terminal_is_no_larger_than_that_and_is_written_over(size, tmp_path, monkeypatch):
    def size_of(descriptor: int) -> os.terminal_size:
        if size is None:
            raise OSError("not a terminal")
        assert descriptor == 2
        return os.terminal_size(size)

    said = []
    monkeypatch.setattr(os, "isatty", lambda descriptor: True)
    monkeypatch.setattr(os, "get_terminal_size", size_of)
    monkeypatch.setattr(atari5, "say", said.append)
    runs = [make_run("SpaceInvaders", "acppo-eps0.08") for _ in range(3)]
    for run in runs:
        run.state = "failed"
    progress = Progress(runs, Args(out=tmp_path))
    progress.show()
    progress.show()
    whole, table = progress.table(), said[0].split("\n")
    assert max(map(len, whole)) > 40 and len(whole) == 4
    columns, lines = size if size and size[0] else (80, 24)
    assert table == [line[: columns - 1] for line in whole[: lines - 1]]
    assert said[1] == f"\x1b[{len(table)}F\x1b[J{said[0]}"  # the cursor stands on the line below the table


# ------------------------------------------------------------------------------------ workers and nodes that are killed
def wait_for_second_start(out: Path, name: str) -> Path:
    """Waits until a second process of a run has finished an iteration; returns the run's directory."""

    def logs_again() -> bool:
        assert all(len(found) == 1 for found in processes(out).values())  # none twice at once
        files = sorted(run_dirs(out)[name].glob("events.*"), key=os.path.getmtime)
        return len(files) == 2 and has_logged(files[1])

    wait_for(logs_again)
    return run_dirs(out)[name]


def resumed_at(run_dir: Path) -> int:
    """Returns the step of the checkpoint that the second process of a run began with."""
    first, second = sorted(run_dir.glob("events.*"), key=os.path.getmtime)
    return steps(second)[0] - 1024


@pytest.mark.slow
def test_a_run_whose_worker_is_killed_writes_its_checkpoint_and_goes_on_from_there(tmp_path):
    driver, name = start(tmp_path, "--games", "CartPole-v1"), "CartPole-v1__ppo__1"
    wait_for(lambda: both_log(tmp_path))
    child = processes(tmp_path)[name][0]
    worker = int(Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()[1])
    reached = steps(run_dirs(tmp_path)[name])[-1]
    os.kill(worker, signal.SIGKILL)
    run_dir = wait_for_second_start(tmp_path, name)
    status, _ = interrupt(driver)
    resumed = resumed_at(run_dir)
    print(f"its worker was killed when it was at step {reached}; it went on from step {resumed}")
    assert status == 130 and resumed >= reached
    assert all(map(is_one_curve, run_dirs(tmp_path).values()))
    assert len(attempts(tmp_path, name)) == 2 and len(attempts(tmp_path, "CartPole-v1__acppo__1")) == 1


@pytest.mark.slow
def test_a_killed_node_costs_time_and_nothing_else(tmp_path):
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        node = cluster.add_node(num_cpus=1)
        driver = start(tmp_path, "--games", "CartPole-v1", "--address", cluster.address)
        wait_for(lambda: both_log(tmp_path))
        before = {name: pids[0] for name, pids in processes(tmp_path).items()}
        killed = time.time()
        cluster.remove_node(node, allow_graceful=False)
        # Its run has to wait for another node, for the head's core is taken and no run ends
        wait_for(lambda: len(processes(tmp_path)) == 1)
        (lost,) = before.keys() - processes(tmp_path).keys()
        cluster.add_node(num_cpus=1)
        run_dir = wait_for_second_start(tmp_path, lost)
        status, said = interrupt(driver)
    finally:
        cluster.shutdown()
    assert status == 130, said
    assert all(map(is_one_curve, run_dirs(tmp_path).values()))
    waited = max(int(path.name.split(".")[3]) for path in run_dir.glob("events.*")) - killed
    print(f"After {waited:.0f} s {lost} went on from step {resumed_at(run_dir)} on another node.")


# ---------------------------------------------------------------------------------------- a run's own checkpoints
def look_at(out: Path, step: int, variant: str = "ppo", script_then: str | None = None, **trained) -> atari5.Run:
    """Returns a run of Qbert that has looked at a checkpoint of this step, trained with its arguments or others.

    `script_then` is what `args.json` has as its script's text; by default it has none, as of an older commit.
    """
    run = make_run("Qbert", variant, total_timesteps=10_000)
    of_run = {"env_id": "Qbert", "seed": 1, "exp_name": run.variant.name, "total_timesteps": 10_000}
    args = bookkeeping.saved_args(SCRIPTS.get(variant, SCRIPTS["ppo"]).Args(**of_run))
    directory = out / "runs" / f"{run.name}__1700000000"
    directory.mkdir(parents=True, exist_ok=True)
    torch.save({"args": {**args, **trained}, "global_step": step}, directory / "checkpoint.pt")
    provenance = {} if script_then is None else {"script": script_then}
    (directory / "args.json").write_text(json.dumps({"provenance": provenance}))
    run.look(Args(out=out, total_timesteps=10_000))
    return run


def test_a_run_is_finished_at_the_last_whole_rollout_of_its_steps(tmp_path):
    assert (look_at(tmp_path, 8192).state, look_at(tmp_path, 9216).state) == ("queued", "done")  # of 10,000


@pytest.mark.parametrize(
    ("trained", "said"),
    [
        ({"clip_coef": 0.16}, "--clip-coef 0.16, not with 0.1"),
        ({"c": 1.0}, "--c 1.0, not with None"),
        ({"env_id": "Pong"}, "--env-id Pong, not with Qbert"),
        ({"seed": 2}, "--seed 2, not with 1"),
        ({"exp_name": "acppo"}, "--exp-name acppo, not with ppo"),
        ({"gamma": 0.9}, "--gamma 0.9, not with 0.99"),
        ({"total_timesteps": 20_000}, "--total-timesteps 20000, not with 10000"),
    ],
)
def test_a_checkpoint_of_another_run_is_not_gone_on_with(trained, said, tmp_path):
    run = look_at(tmp_path, 1024, **trained)
    assert run.state == "failed" and said in run.reason


def test_of_two_directories_of_a_run_the_newer_is_gone_on_with(tmp_path):
    look_at(tmp_path, 1024)
    older = tmp_path / "runs" / "Qbert__ppo__1__1700000000"
    newer = older.rename(older.with_name("Qbert__ppo__1__1700000100"))
    look_at(tmp_path, 2048)
    assert make_run("Qbert", "ppo").checkpoint(Args(out=tmp_path)) == newer / "checkpoint.pt"


# ------------------------------------------------------------------------------------------- a variant of one's own
@pytest.fixture
def my_ppo(tmp_path, monkeypatch) -> Path:
    """A script in the current directory."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copy(ROOT / "ppo_atari.py", tmp_path / "my_ppo.py"))


@pytest.mark.parametrize(
    ("variants", "said"),
    [
        (["mine=nowhere.py"], "--variants mine=nowhere.py: cannot be read"),
        (["mine="], "--variants mine=: cannot be read"),
        (["mine=my_ppo.py --exp 'x"], "cannot be read (No closing quotation)"),
        (["mine=my_ppo.py --clip-coeff 0.2"], "cannot be used (Unrecognized options: --clip-coeff"),
        (["mine=my_ppo.py --clip-coef"], "cannot be used (Missing value for argument '--clip-coef'"),
        (["mine=my_ppo.py --clip-coef x"], "cannot be used (Error parsing --clip-coef: "),
        (["mine=my_ppo.py --clip-coef -1"], "--clip-coef -1.0: give a number above 0"),
        (["mine=my_ppo.py --num-minibatches 3"], "--num-minibatches 3: give a divisor"),
        (["mine=my_ppo.py --seed 2"], "leave --seed to the grid"),
        (["mine=my_ppo.py --env_id=Pong"], "leave --env_id=Pong to the grid"),
        (["mine=my_ppo.py -h"], "leave -h to the grid"),
        (["my__ppo=my_ppo.py"], "no '__' in the name"),
        (["../mine=my_ppo.py"], "ANOTHER-NAME"),
        (["=my_ppo.py"], "ANOTHER-NAME"),
        (["ppo=my_ppo.py"], "ANOTHER-NAME"),
        (["mine=my_ppo.py", "mine=my_ppo.py --clip-coef 0.2"], "give each variant a name of its own"),
        (["ppo", "mine=broken.py"], "broken.py cannot be used (SyntaxError"),
        (["ppo", "mine=raises.py"], "raises.py cannot be used (ZeroDivisionError"),
        (["ppo", "mine=ends.py"], "ends.py cannot be used (SystemExit"),
        (["ppo", "mine=other.py"], "other.py cannot be used (AttributeError"),
        (["ppo", "mine=foreign.py"], "foreign.py cannot be used (Unrecognized options: --exp-name"),
        (["ppo", "mine=lawless.py"], "lawless.py cannot be used (AttributeError"),
        (["ppo", "mine=odd.py"], "odd.py cannot be used (ZeroDivisionError"),
    ],
)
def test_a_variant_that_cannot_be_trained_is_refused_in_one_line(variants, said, my_ppo, call):
    texts = {"broken": "print(", "raises": "1 / 0", "ends": "raise SystemExit(3)", "other": "x = 1"}
    texts["foreign"] = "import dataclasses\n@dataclasses.dataclass\nclass Args:\n    total_timesteps: int = 1\n"
    whole = my_ppo.read_text()
    texts |= {
        "lawless": whole.replace("def rules", "def of_another_name"),
        "odd": whole + "\nArgs.rules = lambda _: 1 / 0",
    }
    for name, text in texts.items():
        my_ppo.with_name(f"{name}.py").write_text(text)
    status, printed, err = call("--out", "out", "--dry-run", "--variants", *variants)
    assert (status, printed, err.count("\n")) == (2, "", 1) and said in err


def test_every_variant_of_the_table_can_be_trained():
    variants = [atari5.read_variant(word, 5_000_000) for word in atari5.VARIANTS]
    assert [variant.name for variant in variants] == list(atari5.VARIANTS)
    assert {variant.arguments["clip_coef"] for variant in variants} > {0.1, 0.16}


def test_the_command_of_a_variant_of_one_s_own_can_be_pasted_and_importing_it_leaves_no_trace(my_ppo, call):
    script = my_ppo.rename(my_ppo.with_name("my ppo"))  # a script may have any name
    script.with_name("mine.py").write_text(script.read_text().replace("import math\n", "import math\nimport beside\n"))
    script.with_name("beside.py").touch()
    variants = ["one='my ppo' --clip-coef 0.2", "two=mine.py --no-norm-adv", "ppo", "ppo"]
    status, printed, said = call(
        "--games", "Pong", "--seeds", "1", "--out", "out", "--dry-run", "--variants", *variants
    )
    assert (status, said) == (0, "")
    one, two, ppo = (shlex.split(line) for line in printed.splitlines())
    assert one[4:8] == [sys.executable, str(script), "--clip-coef", "0.2"] and one[8:10] == ["--env-id", "Pong"]
    assert two[5:7] == [str(script.with_name("mine.py")), "--no-norm-adv"] and two[two.index("--exp-name") + 1] == "two"
    assert ppo[5] == str(ROOT / "ppo_atari.py")
    assert not list(my_ppo.parent.glob("__pycache__/m*")) and not (my_ppo.parent / "out").exists()


def test_a_run_of_another_text_of_its_script_is_neither_gone_on_with_nor_finished(my_ppo, tmp_path):
    then = bookkeeping.provenance(str(my_ppo))["script"]
    states = [look_at(tmp_path, step, "mine=my_ppo.py", then).state for step in (1024, 9216)]
    assert states == ["queued", "done"]
    my_ppo.write_text(my_ppo.read_text().replace("values.square()", "values.abs()") + "# another thought\n")
    for step in (1024, 9216):
        run = look_at(tmp_path, step, "mine=my_ppo.py", then)
        assert run.state == "failed" and "is trained by another text of my_ppo.py; move it away" in run.reason
    # The flag is named if both differ, and a run that has no hash is held against its arguments alone
    assert "--gamma 0.9, not with 0.99" in look_at(tmp_path, 1024, "mine=my_ppo.py", then, gamma=0.9).reason
    assert look_at(tmp_path, 9216, "mine=my_ppo.py").state == "done"
    (tmp_path / "runs" / "Qbert__mine__1__1700000000" / "args.json").unlink()
    run = make_run("Qbert", "mine=my_ppo.py", 10_000)
    run.look(Args(out=tmp_path, total_timesteps=10_000))
    assert run.state == "done"


@pytest.mark.parametrize("flags", ["", "--clip-coef 0.10", "--clip_coef=1e-1 --norm-adv", "--target-kl None"])
def test_another_spelling_of_its_flags_is_the_same_run(flags, my_ppo, tmp_path):
    assert look_at(tmp_path, 1024, f"mine=my_ppo.py {flags}").state == "queued"
    assert look_at(tmp_path, 1024, f"mine=my_ppo.py {flags}", clip_coef=0.2).state == "failed"


@pytest.mark.parametrize(
    "trained",
    [
        {"threads": 7},
        {"log_dir": "elsewhere"},
        {"eval_episodes": 3},
        {"checkpoint_minutes": 0.0},
        {"capture_video": True},
        {"bf16": True},
        {"compile": False},  # of older commits
    ],
    ids=str,
)
def test_what_leaves_the_curve_as_it_is_or_is_the_grid_s_makes_no_other_run(trained, tmp_path):
    assert look_at(tmp_path, 1024, **trained).state == "queued"


def test_bf16_among_a_variant_s_own_flags_is_part_of_it(my_ppo, tmp_path):
    run = look_at(tmp_path, 9216, "mine=my_ppo.py --bf16")
    assert run.state == "failed" and "--bf16 False, not with True" in run.reason
    assert look_at(tmp_path, 9216, "mine=my_ppo.py --bf16", bf16=True).state == "done"


def test_a_script_that_is_edited_while_the_grid_runs_starts_no_run_of_its_new_text(my_ppo, tmp_path, monkeypatch):
    monkeypatch.setattr(atari5, "run_process", lambda *_: pytest.fail("it was started"))
    run = make_run("CartPole-v1", "mine=my_ppo.py")
    (tmp_path / "logs").mkdir()
    my_ppo.write_text(my_ppo.read_text() + "# another thought\n")
    assert "my_ppo.py has been edited since this call began" in atari5.train(run, Args(out=tmp_path), None)


@pytest.mark.parametrize(
    ("variants", "pair"),
    [
        (["ppo", "mine=my_ppo.py", "product"], ["--baseline", "ppo", "--challenger", "mine"]),
        (["mine=my_ppo.py", "ppo"], ["--baseline", "mine", "--challenger", "ppo"]),
        (["mine=my_ppo.py", "acppo", "ppo"], []),  # figures.py's own are ppo and acppo
        (["mine=my_ppo.py"], []),
    ],
)
def test_the_figures_compare_the_thesis_s_two_or_else_the_first_two_variants(variants, pair, my_ppo, call, monkeypatch):
    drawn = []

    def draw(command: list[str]) -> subprocess.CompletedProcess:
        drawn.append(command)
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setattr(atari5.Run, "look", lambda run, _: setattr(run, "state", "done"))
    monkeypatch.setattr(atari5.subprocess, "run", draw)
    assert call("--out", "out", "--games", "Qbert", "--variants", *variants)[0] == 0
    assert drawn == [
        [sys.executable, str(ROOT / "benchmark" / "figures.py"), "--out", str(Path("out").resolve()), *pair]
    ]


def test_no_figure_shows_a_refused_run_as_the_grid_s(my_ppo, tmp_path, call, monkeypatch):
    look_at(tmp_path, 9216, "ppo")
    look_at(tmp_path, 9216, "mine=my_ppo.py", gamma=0.9)
    monkeypatch.setattr(atari5.subprocess, "run", lambda *_: pytest.fail("figures were drawn"))
    flags = ("--games", "Qbert", "--seeds", "1", "--total-timesteps", "10000", "--out", str(tmp_path))
    status, _, said = call(*flags, "--variants", "ppo", "mine=my_ppo.py")
    assert status == 1 and "--gamma 0.9, not with 0.99" in said and "1 of 2 runs are done" in said
