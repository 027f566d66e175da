"""A run is never lost: checkpoints, resuming, signals, and faults that are provoked for real."""

import math
import os
import random
import re
import shlex
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
import torch
from tbparse import SummaryReader
from torch.utils.tensorboard import SummaryWriter

import bookkeeping
from conftest import (
    SCRIPTS,
    SMALL,
    checkpoint_of,
    flags_of,
    open_run,
    reproducible,
    run_dir_in,
    scalars,
    train,
    values,
)
from siblings import PPO, load
from wrappers import env_seeds, make_envs

CARTPOLE = {"env_id": "CartPole-v1", **SMALL, "learning_rate": 2.5e-4}
ITERATION = SMALL["num_envs"] * SMALL["num_steps"]
CANNOT_END = {"total_timesteps": 10**9}  # before a test lets it
EVERY_ITERATION = "charts/learning_rate"


def per_iteration(logged: dict) -> dict[str, list[int]]:
    """Steps of the tags that are written once an iteration."""
    return {tag: [step for step, _ in points] for tag, points in logged.items() if "episodic_" not in tag}


def test_stopped_and_resumed_logs_what_straight_through_logs(script, tmp_path, call_main):
    """Bit for bit, where all games are alike and end with the rollout, so that a resume has no other games to play.

    The learning rate is large, so that ratios leave their ranges.
    """
    sizes = {"num_envs": 2, "num_steps": 16, "total_timesteps": 128, "num_minibatches": 4, "threads": 1}
    flags = flags_of(env_id="tiny_envs:SameGame-v0", learning_rate=0.01, **sizes)
    assert call_main(script, *flags, "--log-dir", "straight").status == 0
    stopped = call_main(script, *flags, "--log-dir", "stopped", "--stop-at", "60")
    run_dir = run_dir_in(tmp_path / "stopped")
    assert stopped[:2] == (0, "") and checkpoint_of(run_dir)["global_step"] == 64
    command = shlex.join([sys.executable, script.__file__, "--resume", str(run_dir)])  # from any directory
    assert stopped.err == f"At --stop-at; continue with: {command}\n"
    status, played, said = call_main(script, "--resume", f"stopped/{run_dir.name}")
    assert (status, said) == (0, "") and played.startswith("10 games at step 128")

    straight, both = (reproducible(scalars(path)) for path in (run_dir_in(tmp_path / "straight"), run_dir))
    differing = [tag for tag in straight.keys() | both.keys() if straight.get(tag) != both.get(tag)]
    assert not differing, "state that the checkpoint lacks? It belongs in a buffer of the agent"
    frame = SummaryReader(str(run_dir)).scalars
    for tag, steps in per_iteration(both).items():
        assert frame[frame.tag == tag].step.tolist() == steps, tag


def test_state_in_a_variable_of_train_is_noticed(tmp_path, monkeypatch, call_main):
    """An ε that decays from its start at every start."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    text = PPO.read_text(encoding="utf-8").replace("args.clip_coef)", "epsilon := 0.99 * epsilon)")
    text = text.replace("    for iteration in ", "    epsilon = args.clip_coef\n    for iteration in ")
    (tmp_path / "decaying.py").write_text(text)
    script = load(tmp_path / "decaying.py")
    with pytest.raises(AssertionError, match="belongs in a buffer"):
        test_stopped_and_resumed_logs_what_straight_through_logs(script, tmp_path, call_main)


def resume(script, run_dir: Path, **arguments) -> None:
    """Goes on with a run as its checkpoint is, without the checks of the command line."""
    args = script.Args(**arguments)
    with open_run(script, run_dir) as run:
        script.train(args, make_envs(args.env_id, args.num_envs), run, run.load(script.Args))


def test_adams_moments_and_the_random_state_survive(script, tmp_path):
    """Resumed at the step where it stops, a run writes the checkpoint that it has read."""
    arguments = {**CARTPOLE, "total_timesteps": 1280, "stop_at": 384}
    train(script, tmp_path, **arguments)
    before = checkpoint_of(tmp_path)
    resume(script, tmp_path, **arguments)
    after = checkpoint_of(tmp_path)
    assert before["optimizer"].keys() == after["optimizer"].keys() and len(before["optimizer"]) > 0
    for index, moments in before["optimizer"].items():
        assert moments.keys() == {"step", "exp_avg", "exp_avg_sq"}
        assert all(torch.equal(value, after["optimizer"][index][name]) for name, value in moments.items())
    assert all(torch.equal(value, after["agent"][name]) for name, value in before["agent"].items())
    assert len(before["rng"]) == len(after["rng"]) and all(map(torch.equal, before["rng"], after["rng"]))
    assert before["last_scores"] == after["last_scores"] and len(before["last_scores"]) > 0
    assert (before["num_starts"], after["num_starts"]) == (1, 2)


def test_a_resumed_run_plays_games_that_it_has_not_played(script, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(script, "env_seeds", lambda *given: drawn.append(env_seeds(*given)) or drawn[-1])
    train(script, tmp_path, **CARTPOLE, total_timesteps=1280, stop_at=128)
    for stop_at in (256, 384):
        resume(script, tmp_path, **CARTPOLE, total_timesteps=1280, stop_at=stop_at)
    assert len(drawn) == 3 and len(set(sum(drawn, []))) == 3 * SMALL["num_envs"]


def killed_and_resumed(script, tmp_path, start, call_main, kills: int) -> dict:
    """Kills a run with SIGKILL at random instants, resumes it each time, and returns the logged scalars.

    A checkpoint is due after every iteration, so that many kills fall into the writing of one; none may lose more than
    the iteration in progress.
    """
    moments = random.Random(2)
    flags, saved = flags_of(**CARTPOLE, **CANNOT_END, checkpoint_minutes=0), 0
    for kill in range(kills):
        process = start(script, *flags)
        if kill % 2 == 0:
            process.wait_for(lambda: newest_step(tmp_path) > saved)  # noqa: B023
            time.sleep(moments.uniform(0, 0.3))
        else:  # at any moment from the start of the process on
            time.sleep(moments.uniform(0, 4))
        process.kill()
        assert process.end() == (-signal.SIGKILL, "", "")
        run_dir = run_dir_in(tmp_path / "runs")
        logged_steps = [step for step, _ in scalars(run_dir).get(EVERY_ITERATION, [])]
        assert max(logged_steps, default=0) - newest_step(tmp_path) <= ITERATION  # the one in progress
        assert newest_step(tmp_path) >= saved
        saved = newest_step(tmp_path)
        flags = ["--resume", str(run_dir)]
    assert call_main(script, *flags, "--stop-at", str(saved + 5 * ITERATION))[:2] == (0, "")
    return scalars(run_dir)


def newest_step(directory: Path) -> int:
    """The agent step of the checkpoint of a directory's run, -1 before there is one."""
    paths = list(directory.glob("runs/*/checkpoint.pt"))
    return checkpoint_of(paths[0].parent)["global_step"] if paths else -1


def check_one_continuous_curve(logged: dict) -> None:
    for tag, steps in per_iteration(logged).items():
        assert len(steps) == len(set(steps)) and steps == sorted(steps), tag
    steps = per_iteration(logged)[EVERY_ITERATION]
    assert len(steps) > 5 and steps == list(range(ITERATION, steps[-1] + 1, ITERATION))
    iterations = CANNOT_END["total_timesteps"] // ITERATION
    rates = [2.5e-4 * (1 - i / iterations) for i in range(len(steps))]
    assert values(logged, EVERY_ITERATION) == pytest.approx(rates, rel=1e-7)  # float32: one iteration is 1.3e-7


@pytest.mark.parametrize("kills", [1, pytest.param(30, marks=pytest.mark.slow)])
def test_a_killed_run_that_is_resumed_is_one_continuous_curve(script, kills, tmp_path, start, call_main):
    check_one_continuous_curve(killed_and_resumed(script, tmp_path, start, call_main, kills))


@pytest.fixture(scope="module")
def finished_runs(tmp_path_factory):
    """A short finished run of each script, not to be changed: copy it."""
    runs = {}

    def run_of(script) -> Path:
        if script not in runs:
            runs[script] = tmp_path_factory.mktemp(script.__name__)
            train(script, runs[script], **CARTPOLE, total_timesteps=256)
        return runs[script]

    return run_of


@pytest.fixture
def finished(script, finished_runs, tmp_path) -> Path:
    """A copy of a finished run's directory, in the test's own."""
    return Path(shutil.copytree(finished_runs(script), tmp_path / "finished"))


def test_a_finished_run_says_so_and_goes_on_with_more_steps(script, finished, call_main):
    status, out, err = call_main(script, "--resume", "finished/checkpoint.pt")
    assert (status, err) == (0, "") and "is finished up to --total-timesteps, at step 256" in out
    longer = call_main(script, "--resume", "finished", "--total-timesteps", "512")
    assert (longer.status, longer.err) == (0, "")
    assert scalars(finished)[EVERY_ITERATION] == [
        (128, pytest.approx(2.5e-4)),
        (256, pytest.approx(1.25e-4)),
        (384, pytest.approx(1.25e-4)),
        (512, pytest.approx(0.625e-4)),
    ]
    frame = SummaryReader(str(finished)).text
    assert any("|total_timesteps|512|" in text for text in frame.value)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--env-id", "Breakout"], "--env-id Breakout: the run has CartPole-v1, which cannot change"),
        (["--num-envs", "8"], "--num-envs 8: the run has 4, which cannot change"),
        (["--num-steps", "64"], "--num-steps 64: the run has 32, which cannot change"),
        (["--seed", "2"], "--seed 2: the run has 1, which cannot change"),
        (["--gamma", "2", "--total-timesteps", "512"], "--gamma 2.0: give a value in 0..1"),
    ],
)
def test_what_cannot_change_is_refused(script, finished, call_main, flags, message):
    assert call_main(script, "--resume", "finished", *flags) == (2, "", message + "\n")


@pytest.mark.thesis
def test_the_run_of_the_other_script_is_refused(script, finished_runs, call_main):
    (other,) = set(SCRIPTS.values()) - {script}
    run_dir = finished_runs(other)
    said = f"--resume {run_dir}: its checkpoint is of another script, which differs in c\n"
    assert call_main(script, "--resume", str(run_dir)) == (2, "", said)


@pytest.mark.parametrize("contents", [None, b"", b"no zip file"])
def test_a_directory_without_a_checkpoint_is_refused(script, contents, tmp_path, call_main):
    if contents is not None:
        (tmp_path / "checkpoint.pt").write_bytes(contents)
    status, _, said = call_main(script, "--resume", str(tmp_path))
    assert status == 2 and said.count("\n") == 1
    assert ("it holds no checkpoint" if contents is None else "damaged") in said


def test_flipped_and_cut_checkpoints_are_refused_or_harmless(script, finished):
    """A byte of padding between the parts of the file may change; nothing that is read from it may."""
    path, offsets = finished / "checkpoint.pt", random.Random(3)
    whole, original, refused = path.read_bytes(), checkpoint_of(finished), 0
    with open_run(script, finished) as run:
        for attempt in range(200):
            damaged = bytearray(whole)
            if attempt % 4 == 0:
                del damaged[offsets.randrange(len(whole)) :]
            else:
                damaged[offsets.randrange(len(whole))] ^= 1 << offsets.randrange(8)
            path.write_bytes(damaged)
            try:
                state = run.load(script.Args)
            except ValueError as error:
                refused += "damaged" in str(error)
            else:
                assert attempt % 4 != 0 and state["args"] == original["args"]
                for part in ("agent", "optimizer", "rng", "last_scores", "global_step"):
                    torch.testing.assert_close(state[part], original[part], rtol=0, atol=0)
    assert refused > 100


class RunsCode:
    """Makes a directory when it is unpickled."""

    def __reduce__(self):
        return os.mkdir, ("made-by-a-checkpoint",)


@pytest.mark.parametrize(
    "change",
    [
        lambda state: {**state, "agent": {name: value * math.nan for name, value in state["agent"].items()}},
        lambda state: {**state, "args": {**state["args"], "env_id": RunsCode()}},
        lambda state: {},
    ],
    ids=["parameters that are not finite", "code", "another file of torch"],
)
def test_a_file_that_no_run_has_written_is_refused_in_one_line(script, finished, change, tmp_path, call_main):
    torch.save(change(checkpoint_of(finished)), finished / "checkpoint.pt")
    status, out, said = call_main(script, "--resume", "finished", "--total-timesteps", "512")
    assert (status, out) == (2, "") and said.startswith("--resume finished: its checkpoint") and said.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["finished"]


def test_two_processes_cannot_hold_one_run(script, finished, call_main):
    """Nor can one process hold it twice; that the lock ends with its process, the killed runs above show."""
    flags = ["--resume", "finished", "--total-timesteps", "512"]
    with open_run(script, finished):
        refusal = "--resume finished: another process holds it; wait for its end\n"
        assert call_main(script, *flags) == (2, "", refusal)
    assert call_main(script, *flags).status == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_the_run_with_a_checkpoint_and_a_command(script, number, tmp_path, start):
    process = start(script, *flags_of(**CARTPOLE, **CANNOT_END, stop_at=5 * 10**8))
    process.wait_for(lambda: any(EVERY_ITERATION in scalars(path) for path in tmp_path.glob("runs/*")))
    process.send_signal(number)
    status, out, said = process.end()
    run_dir = run_dir_in(tmp_path / "runs")
    assert (status, out) == (128 + number, "") and said.endswith(f"--resume {run_dir} --stop-at 500000000\n")
    assert checkpoint_of(run_dir)["global_step"] == scalars(run_dir)[EVERY_ITERATION][-1][0] > 0


def test_two_signals_at_once_count_as_one(monkeypatch, capfd):
    """Launchers send the same signal to a process and to its group."""
    clock, ended = [100.0], []
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(os, "_exit", ended.append)
    stop = bookkeeping.StopSignal()
    for clock[0] in (100.0, 100.003, 100.9):
        stop.note(signal.SIGTERM, None)
    assert (stop.number, ended) == (signal.SIGTERM, []) and capfd.readouterr().err.count("\n") == 1
    clock[0] = 101.0
    stop.note(signal.SIGINT, None)
    assert ended == [128 + signal.SIGINT]


def test_a_signal_that_is_ignored_at_the_start_stays_ignored(monkeypatch):
    """As after `nohup`, and in the background of a plain `sh`."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        stop = bookkeeping.StopSignal()
        stop.listen()
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN and stop.number == 0
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.number == signal.SIGTERM
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)


@pytest.mark.parametrize("where", ["value_loss", "surrogate"])
def test_a_number_that_is_not_finite_stops_the_run_before_it_is_saved(script, where, tmp_path, monkeypatch, call_main):
    function, calls = getattr(script, where), []
    poisoned = lambda *given: function(*given) * (float("nan") if calls.append(1) or len(calls) > 16 else 1)  # noqa: E731
    monkeypatch.setattr(script, where, poisoned)
    status, out, said = call_main(script, *flags_of(**CARTPOLE, total_timesteps=1280, checkpoint_minutes=0))
    assert (status, out) == (1, "") and said.count("\n") == 1
    assert re.search(r"not finite in iteration 2, step 256: .*(policy_loss|value_loss).*actor", said)
    state = checkpoint_of(run_dir_in(tmp_path / "runs"))
    assert state["global_step"] == 128
    assert all(value.isfinite().all() for value in state["agent"].values())


def bytes_after(script, directory: Path, iterations: int) -> tuple[int, int]:
    """The sizes of checkpoint and event file of a run that stops after so many iterations."""
    train(script, directory, **CARTPOLE, total_timesteps=1280, stop_at=iterations * ITERATION)
    (events,) = directory.glob("events.*")
    return (directory / "checkpoint.pt").stat().st_size, events.stat().st_size


@pytest.mark.parametrize(
    "too_large",
    [
        "the checkpoint with Adam's moments",
        pytest.param("every checkpoint", marks=pytest.mark.slow),
        pytest.param("the event file", marks=pytest.mark.slow),
    ],
)
def test_a_full_disk_is_said_once_and_training_goes_on(script, too_large, tmp_path, start):
    """No file may grow beyond a limit: writes fail as on a full disk."""
    first, events_before = bytes_after(script, tmp_path / "measured 0", 0)
    later, events_after = bytes_after(script, tmp_path / "measured 5", 5)
    iterations = 5
    if too_large == "the event file":
        limit = 2 * later
        iterations += int(1.5 * limit / ((events_after - events_before) / 5))  # it, and half of its successor
    else:
        limit = first // 2 if too_large == "every checkpoint" else (first + later) // 2
        assert events_after < 0.9 * limit
    total = iterations * ITERATION
    process = start(
        script, *flags_of(**CARTPOLE, total_timesteps=total, checkpoint_minutes=0, eval_episodes=0), file_size=limit
    )
    status, out, said = process.end()
    assert (status, out) == (1, "") and said.count("carrying on") == 1
    assert ("Not saved; continue with: " in said) == (too_large == "the checkpoint with Adam's moments")
    run_dir = run_dir_in(tmp_path / "runs")
    assert not (run_dir / "checkpoint.pt.new").exists()
    if too_large == "every checkpoint":
        assert not (run_dir / "checkpoint.pt").exists()
    else:
        assert checkpoint_of(run_dir)["global_step"] == (total if too_large == "the event file" else 0)
    steps = [step for step, _ in scalars(run_dir)[EVERY_ITERATION]]
    assert steps == sorted(set(steps)) and steps[-1] == total
    assert len(steps) >= iterations - 2 and len(list(run_dir.glob("events.*"))) == 1 + (too_large == "the event file")


def test_an_event_file_that_cannot_be_written_has_a_successor(script, tmp_path, monkeypatch):
    """The second iteration's points are lost."""
    flush, flushed = SummaryWriter.flush, []

    def flush_all_but_the_third(writer):  # the first has the arguments
        flushed.append(writer)
        if len(flushed) == 3:
            os.truncate(*next((path, path.stat().st_size // 2) for path in tmp_path.glob("events.*")))
            raise OSError("no space")
        flush(writer)

    monkeypatch.setattr(SummaryWriter, "flush", flush_all_but_the_third)
    logged = train(script, tmp_path, **CARTPOLE, total_timesteps=4 * ITERATION)
    assert [step for step, _ in logged["losses/kl"]][-2:] == [3 * ITERATION, 4 * ITERATION]
    assert len(list(tmp_path.glob("events.*"))) == 2


def test_a_checkpoint_that_breaks_off_leaves_the_one_before_it(script, tmp_path, monkeypatch, capfd):
    args = script.Args(env_id="CartPole-v1", total_timesteps=1280, stop_at=128, **SMALL)
    run = script.RunDirectory(str(tmp_path))
    agent = script.train(args, make_envs("CartPole-v1", 4), run)
    whole = (tmp_path / "checkpoint.pt").read_bytes()

    def break_off(state, file):
        file.write(whole[:1000])
        assert (tmp_path / "checkpoint.pt").read_bytes() == whole  # a process that is killed now leaves it so
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", break_off)
    optimizer = torch.optim.Adam(agent.parameters())
    run.save(args, 2, agent, optimizer)
    assert (tmp_path / "checkpoint.pt").read_bytes() == whole and run.write_errors
    assert "(No space left on device); carrying on" in capfd.readouterr().err
