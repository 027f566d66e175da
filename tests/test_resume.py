"""A run is never lost: checkpoints, resuming, signals, and faults that are provoked for real."""

import json
import math
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tbparse import SummaryReader

from conftest import ONE_IN_THE_PLAIN_RUN, SCRIPTS, TINY_PIXELS, run_script, scalars, values
from wrappers import make_envs

SMALL = {"num_envs": 4, "num_steps": 32, "threads": 1}
EVERY_ITERATION = "charts/learning_rate"


@pytest.fixture(params=ONE_IN_THE_PLAIN_RUN, ids=["acppo", "ppo"])
def script(request):
    return request.param


def flags_of(**arguments) -> list[str]:
    return [word for name, value in arguments.items() for word in (f"--{name.replace('_', '-')}", str(value))]


def run_dir_in(directory: Path) -> Path:
    (run_dir,) = (directory / "runs").iterdir()
    return run_dir


def checkpoint_of(run_dir: Path) -> dict:
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


def per_iteration(logged: dict) -> dict[str, list[int]]:
    """Steps of the tags that are written once an iteration."""
    return {tag: [step for step, _ in points] for tag, points in logged.items() if "episodic_" not in tag}


@pytest.mark.parametrize("env_id", ["CartPole-v1", pytest.param(TINY_PIXELS, marks=pytest.mark.slow)])
def test_stopped_and_resumed_logs_what_straight_through_logs(script, env_id, tmp_path):
    """The games start anew, so that their scores differ; schedule, steps and tags do not."""
    flags = flags_of(env_id=env_id, total_timesteps=1280, **SMALL)
    for name in ("straight", "stopped"):
        (tmp_path / name).mkdir()
    assert run_script(script, *flags, cwd=tmp_path / "straight").returncode == 0
    stopped = run_script(script, *flags, "--stop-at", "600", cwd=tmp_path / "stopped")
    run_dir = run_dir_in(tmp_path / "stopped")
    assert stopped.returncode == 0 and checkpoint_of(run_dir)["global_step"] == 640
    resumed = run_script(script, "--resume", f"runs/{run_dir.name}", cwd=tmp_path / "stopped")
    assert (resumed.returncode, resumed.stderr) == (0, "")

    straight, both = scalars(run_dir_in(tmp_path / "straight")), scalars(run_dir)
    assert both[EVERY_ITERATION] == straight[EVERY_ITERATION]
    assert per_iteration(both) == per_iteration(straight)
    frame = SummaryReader(str(run_dir)).scalars
    for tag, steps in per_iteration(both).items():
        assert frame[frame.tag == tag].step.tolist() == steps, tag


def test_adams_moments_and_the_random_state_survive(script, tmp_path):
    """Resumed at the step where it stops, a run writes the checkpoint that it has read."""
    args = script.Args(env_id="CartPole-v1", total_timesteps=1280, stop_at=384, **SMALL)
    run = script.RunDirectory(str(tmp_path))
    script.train(args, make_envs("CartPole-v1", 4), run)
    before = checkpoint_of(tmp_path)
    os.close(run.lock)
    run = script.RunDirectory(str(tmp_path))
    script.train(args, make_envs("CartPole-v1", 4), run, run.load(script.Args))
    after = checkpoint_of(tmp_path)
    assert before["optimizer"].keys() == after["optimizer"].keys() and len(before["optimizer"]) > 0
    for index, moments in before["optimizer"].items():
        assert moments.keys() == {"step", "exp_avg", "exp_avg_sq"}
        assert all(torch.equal(value, after["optimizer"][index][name]) for name, value in moments.items())
    assert all(torch.equal(value, after["agent"][name]) for name, value in before["agent"].items())
    assert len(before["rng"]) == len(after["rng"]) and all(map(torch.equal, before["rng"], after["rng"]))
    assert before["last_scores"] == after["last_scores"] and len(before["last_scores"]) > 0
    assert (before["starts"], after["starts"]) == (1, 2)


def wait_until(condition, process: subprocess.Popen, seconds: float = 120) -> None:
    """Waits for something that a process does; fails where the process has ended without it, or takes too long."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def killed_and_resumed(script, tmp_path, kills: int, seed: int) -> dict:
    """Kills a run with SIGKILL at random instants, resumes it each time to the end, and returns what was logged.

    A checkpoint is due after every iteration, so that many kills fall into the writing of one; none may lose more than
    the iteration in progress.
    """
    moments = random.Random(seed)
    flags = flags_of(env_id="CartPole-v1", total_timesteps=128_000, checkpoint_minutes=0, **SMALL)
    command, saved = [sys.executable, script.__file__, *flags], 0
    for kill in range(kills):
        process = subprocess.Popen(command, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
        wait_until(lambda: list(tmp_path.glob("runs/*/checkpoint.pt")), process)
        run_dir = run_dir_in(tmp_path)
        begun = checkpoint_of(run_dir)["starts"]
        if kill % 2 == 0:  # every other kill comes at any moment from the start of the process on
            wait_until(lambda: kill == 0 or checkpoint_of(run_dir)["starts"] > begun, process)  # noqa: B023
        time.sleep(moments.uniform(0, 0.3 if kill % 2 == 0 else 4))
        process.kill()
        assert process.communicate()[1] == "" and process.returncode == -signal.SIGKILL
        state = checkpoint_of(run_dir)
        logged_steps = [step for step, _ in scalars(run_dir).get(EVERY_ITERATION, [])]
        assert state["global_step"] >= saved
        assert max(logged_steps, default=0) - state["global_step"] <= 128  # one checkpoint interval: an iteration
        saved = state["global_step"]
        command = [sys.executable, script.__file__, "--resume", str(run_dir)]
    last = subprocess.run([*command, "--stop-at", str(saved + 640)], cwd=tmp_path, capture_output=True, text=True)
    assert (last.returncode, last.stderr) == (0, "")
    return scalars(run_dir)


def check_one_continuous_curve(logged: dict) -> None:
    for tag, steps in per_iteration(logged).items():
        assert len(steps) == len(set(steps)) and steps == sorted(steps), tag
    steps = per_iteration(logged)[EVERY_ITERATION]
    assert steps == list(range(128, steps[-1] + 1, 128))
    rates = [2.5e-4 * (1 - i / 1000) for i in range(len(steps))]
    assert values(logged, EVERY_ITERATION) == pytest.approx(rates)


def test_a_run_killed_twice_is_one_continuous_curve(script, tmp_path):
    check_one_continuous_curve(killed_and_resumed(script, tmp_path, kills=2, seed=1))


@pytest.mark.slow
def test_a_run_killed_thirty_times_is_one_continuous_curve(script, tmp_path):
    check_one_continuous_curve(killed_and_resumed(script, tmp_path, kills=30, seed=2))


@pytest.fixture(scope="module")
def finished_runs(tmp_path_factory):
    """A short finished run of each script, not to be changed: copy it."""
    runs = {}

    def run_of(script) -> Path:
        if script not in runs:
            directory = tmp_path_factory.mktemp(script.__name__)
            flags = flags_of(env_id="CartPole-v1", total_timesteps=256, **SMALL)
            assert run_script(script, *flags, cwd=directory).returncode == 0
            runs[script] = run_dir_in(directory)
        return runs[script]

    return run_of


@pytest.fixture
def finished(script, finished_runs, tmp_path) -> Path:
    """A copy of a finished run's directory, under `runs/` of the test's own directory."""
    original = finished_runs(script)
    return Path(shutil.copytree(original, tmp_path / "runs" / original.name))


def test_a_finished_run_says_so_and_goes_on_with_more_steps(script, finished, tmp_path):
    again = run_script(script, "--resume", str(finished), cwd=tmp_path)
    assert (
        again.returncode == 0
        and "is finished up to --total-timesteps, at step 256" in again.stdout
        and again.stderr == ""
    )
    longer = run_script(script, "--resume", str(finished), "--total-timesteps", "512", cwd=tmp_path)
    assert (longer.returncode, longer.stderr) == (0, "")
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
        (["--seed", "2"], "--seed 2: the run has 1, which cannot change"),
        (["--gamma", "2", "--total-timesteps", "512"], "--gamma 2.0: give a number from 0 to 1"),
    ],
)
def test_what_cannot_change_is_refused(script, finished, call_main, flags, message):
    assert call_main(script, "--resume", str(finished), *flags) == (2, "", message + "\n")


def test_the_run_of_the_other_script_is_refused(script, finished_runs, tmp_path, call_main):
    (other,) = set(SCRIPTS.values()) - {script}
    run_dir = shutil.copytree(finished_runs(other), tmp_path / "other")
    status, _, said = call_main(script, "--resume", str(run_dir))
    assert (status, said) == (2, f"--resume {run_dir}: its checkpoint is of another script, which differs in c\n")


@pytest.mark.parametrize("contents", [None, b"", b"no zip file"])
def test_a_directory_without_a_checkpoint_is_refused(script, contents, tmp_path, call_main):
    if contents is not None:
        (tmp_path / "checkpoint.pt").write_bytes(contents)
    status, _, said = call_main(script, "--resume", str(tmp_path))
    assert status == 2 and said.count("\n") == 1
    assert ("it holds no checkpoint" if contents is None else "damaged") in said


def test_a_directory_that_is_not_there_is_refused(script, call_main):
    assert call_main(script, "--resume", "nowhere") == (2, "", "--resume nowhere: No such file or directory\n")


def test_flipped_and_cut_checkpoints_are_refused_or_harmless(script, finished):
    """A byte of padding between the parts of the file may change; nothing that is read from it may."""
    run = script.RunDirectory(str(finished))
    path, offsets = finished / "checkpoint.pt", random.Random(3)
    whole, original = path.read_bytes(), run.load(script.Args)
    refused = 0
    for attempt in range(200):
        damaged = bytearray(whole)
        if attempt % 4 == 0:
            damaged = damaged[: offsets.randrange(len(whole))]
        else:
            damaged[offsets.randrange(len(whole))] ^= 1 << offsets.randrange(8)
        path.write_bytes(damaged)
        try:
            state = run.load(script.Args)
        except ValueError as error:
            refused += "damaged" in str(error)
        else:
            assert attempt % 4 != 0
            assert state["args"] == original["args"] and state["global_step"] == original["global_step"]
            assert all(torch.equal(value, original["agent"][name]) for name, value in state["agent"].items())
            for index, moments in original["optimizer"].items():
                assert all(torch.equal(value, state["optimizer"][index][name]) for name, value in moments.items())
    assert refused > 100


@pytest.mark.parametrize(
    "change",
    [
        lambda state: {**state, "args": {**state["args"], "learning_rate": "fast"}},
        lambda state: {**state, "agent": {"weight": torch.zeros(2)}},
        lambda state: {**state, "agent": {name: value * math.nan for name, value in state["agent"].items()}},
        lambda state: {**state, "optimizer": {0: {**state["optimizer"][0], "exp_avg": torch.zeros(3)}}},
        lambda state: {**state, "starts": -1},
        lambda state: {**state, "starts": 10**12},
        lambda state: {name: value for name, value in state.items() if name != "rng"},
        lambda state: {name: value for name, value in state.items() if name != "starts"},
        lambda state: {name: value for name, value in state.items() if name != "global_step"},
        lambda state: {**state, "args": {**state["args"], "target_kl": "fast"}},
        lambda state: {**state, "iteration": "1"},
        lambda state: {**state, "iteration": 1},
        lambda state: {**state, "last_scores": ["a"]},
        lambda state: {},
        lambda state: [1, 2],
    ],
    ids=[
        "a number as text",
        "another network",
        "parameters that are not finite",
        "moments of another shape",
        "fewer starts than none",
        "more starts than there can be",
        "no rng",
        "no starts",
        "no global_step",
        "target_kl",
        "text for a number",
        "another step",
        "scores",
        "nothing",
        "a list",
    ],
)
def test_a_checkpoint_changed_by_hand_is_refused_in_one_line(script, finished, change, call_main):
    torch.save(change(checkpoint_of(finished)), finished / "checkpoint.pt")
    status, out, said = call_main(script, "--resume", str(finished), "--total-timesteps", "512")
    assert (
        (status, out) == (2, "") and said.startswith(f"--resume {finished}: its checkpoint") and said.count("\n") == 1
    )


def test_two_processes_cannot_hold_one_run(script, finished, tmp_path):
    held = script.RunDirectory(str(finished))
    second = run_script(script, "--resume", str(finished), "--total-timesteps", "512", cwd=tmp_path)
    os.close(held.lock)
    assert second.returncode == 2
    assert second.stderr == f"--resume {finished}: another process holds it; wait for its end\n"
    third = run_script(script, "--resume", str(finished), "--total-timesteps", "512", cwd=tmp_path)
    assert third.returncode == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)])
def test_a_signal_ends_the_run_with_a_checkpoint_and_the_command_to_go_on(script, number, tmp_path):
    flags = flags_of(env_id="CartPole-v1", total_timesteps=10_000_000, stop_at=5_000_000, **SMALL)
    process = subprocess.Popen(
        [sys.executable, script.__file__, *flags], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: has_a_point(tmp_path), process)
    process.send_signal(number)
    said = process.communicate(timeout=60)[1]
    assert process.returncode == 128 + number
    run_dir = run_dir_in(tmp_path)
    assert said.endswith(f"--resume runs/{run_dir.name} --stop-at 5000000\n")
    assert checkpoint_of(run_dir)["global_step"] == scalars(run_dir)[EVERY_ITERATION][-1][0] > 0


def has_a_point(directory: Path) -> bool:
    return (directory / "runs").exists() and EVERY_ITERATION in scalars(run_dir_in(directory))


def test_a_second_signal_ends_at_once(script, tmp_path):
    """An iteration that takes minutes is not waited for."""
    flags = flags_of(env_id="CartPole-v1", num_envs=4, num_steps=250_000, total_timesteps=1_000_000, threads=1)
    process = subprocess.Popen(
        [sys.executable, script.__file__, *flags], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    wait_until(lambda: list(tmp_path.glob("runs/*/checkpoint.pt")), process)
    process.send_signal(signal.SIGTERM)
    assert "once more" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == -signal.SIGTERM


@pytest.mark.parametrize("where", ["value_loss", "surrogate"])
def test_a_number_that_is_not_finite_stops_the_run_before_it_is_saved(script, where, tmp_path, monkeypatch, capfd):
    function, calls = getattr(script, where), []
    poisoned = lambda *given: function(*given) * (float("nan") if calls.append(1) or len(calls) > 16 else 1)  # noqa: E731
    monkeypatch.setattr(script, where, poisoned)
    args = script.Args(env_id="CartPole-v1", total_timesteps=1280, checkpoint_minutes=0, **SMALL)
    with pytest.raises(SystemExit) as stopped:
        script.train(args, make_envs("CartPole-v1", 4), script.RunDirectory(str(tmp_path)))
    assert stopped.value.code == 1
    said = capfd.readouterr().err
    assert re.search(r"not finite in iteration 2, step 256: .*(policy_loss|value_loss).*actor", said)
    state = checkpoint_of(tmp_path)
    assert state["global_step"] == 128
    assert all(value.isfinite().all() for value in state["agent"].values())


@pytest.mark.parametrize(
    ("bytes_allowed", "total", "last_saved"),
    [
        pytest.param(40_000, 2560, None, marks=pytest.mark.slow),  # no checkpoint, ever
        (120_000, 7680, 0),  # no checkpoint with Adam's moments
        pytest.param(160_000, 128_000, 128_000, marks=pytest.mark.slow),  # an event file grows too large
    ],
)
def test_a_full_disk_is_said_once_and_training_goes_on(script, bytes_allowed, total, last_saved, tmp_path):
    """No file may grow beyond the limit, which is what the disk says when it is full."""
    flags = flags_of(env_id="CartPole-v1", total_timesteps=total, checkpoint_minutes=0.01, **SMALL)
    run = subprocess.run(
        [sys.executable, script.__file__, *flags],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_allowed, bytes_allowed)),
    )
    assert run.returncode == 1
    (said,) = [line for line in run.stderr.splitlines() if not line.startswith("step ")]  # a line a minute
    assert "the run goes on" in said
    run_dir = run_dir_in(tmp_path)
    assert not (run_dir / "checkpoint.pt.new").exists()
    if last_saved is None:
        assert not (run_dir / "checkpoint.pt").exists()
    else:
        assert checkpoint_of(run_dir)["global_step"] == last_saved
    steps = [step for step, _ in scalars(run_dir)[EVERY_ITERATION]]
    assert steps == sorted(set(steps))
    if last_saved == total:  # the event file has a successor, which got the last points
        assert len(list(run_dir.glob("events.*"))) > 1 and steps[-1] > total - 64 * 128
    else:
        assert steps[-1] == total


def test_the_last_checkpoint_is_enough_to_play(script, finished):
    state = checkpoint_of(finished)
    envs = make_envs(state["args"]["env_id"], 1)
    agent = script.Agent(envs.single_observation_space.shape, int(envs.single_action_space.n))
    agent.load_state_dict(state["agent"])
    obs, _ = envs.reset(seed=[1])
    for _ in range(10):
        actions, _, _ = script.act(agent, torch.from_numpy(obs).movedim(1, -1))
        obs, *_ = envs.step(actions.numpy())


numbers = st.one_of(
    st.sampled_from(
        [-1, 0, 1, 2, 3, 4, 32, 128, 1024, 0.1, 0.5, 1e-3, 1e30, "nan", "inf", "-inf", "1e3", "x", "", "None"]
    ),
    st.integers(-3, 40),
    st.floats(-1, 2, allow_nan=False).map(lambda value: f"{value:.3f}"),
)
sizes = st.one_of(st.integers(-1, 9), st.sampled_from([16, 32, 64, "4.5", "x"]))
names = st.sampled_from(
    ["CartPole-v1", "Acrobot-v1", TINY_PIXELS, "Brekout", "Pendulum-v1", "a:b:c", "", "\n", "ALE/", "-"]
)
NUMBERS = "learning_rate gamma gae_lambda clip_coef vf_clip_coef ent_coef vf_coef max_grad_norm target_kl seed".split()
ODD = {  # what any flag might be given
    **dict.fromkeys(("num_envs", "num_steps", "num_minibatches", "update_epochs"), sizes),
    **dict.fromkeys((*NUMBERS, "checkpoint_minutes", "stop_at"), numbers),
    "total_timesteps": st.integers(-1, 700),
    "env_id": names,
    "exp_name": st.sampled_from(["a", "a/b", "..", "", "ä", "x" * 300]),
    "log_dir": st.sampled_from(["runs", "a/b", "taken", "taken/b", "/proc/none", ""]),
    "resume": st.sampled_from(["nowhere", "taken", "", "."]),
    "evaluate": st.sampled_from(["nowhere", "taken", "", "."]),
    "eval_episodes": st.sampled_from([-1, 0, 1, 3, 10**20, "x"]),
    "threads": st.integers(-1, 2),
}
SENSIBLE = {
    "num_envs": st.integers(1, 4),
    "num_steps": st.sampled_from([4, 8, 16]),
    "num_minibatches": st.sampled_from([1, 2, 4]),
    "total_timesteps": st.integers(64, 200),
    "gamma": st.floats(0, 1),
    "learning_rate": st.floats(1e-9, 1e3),
    "env_id": st.sampled_from(["CartPole-v1", "Acrobot-v1", TINY_PIXELS]),
}
# Sensible ones, of which up to three flags are given something odd
COMMAND_LINES = st.tuples(
    st.fixed_dictionaries(SENSIBLE),
    st.lists(st.one_of(*(st.tuples(st.just(name), values) for name, values in ODD.items())), max_size=3).map(dict),
).map(lambda drawn: drawn[0] | drawn[1])


@pytest.mark.slow
def test_every_command_line_trains_or_is_refused_in_one_line(script, tmp_path, monkeypatch, call_main):
    """300 command lines, sensible and not, through `main` in this process; none may end in a traceback."""
    outcomes = Counter()

    @settings(max_examples=300, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(COMMAND_LINES, st.integers(0, 2**63))
    def check(arguments, number):
        directory = tmp_path / str(number)
        directory.mkdir(exist_ok=True)
        (directory / "taken").write_text("a file")
        monkeypatch.chdir(directory)
        arguments = {"threads": 1, "eval_episodes": 0, **arguments}
        status, out, err = call_main(script, *(f"--{k.replace('_', '-')}={v}" for k, v in arguments.items()))
        assert "Traceback" not in out + err
        if status == 2:
            assert err.count("\n") == 1 or "╭" in err
            assert [path.name for path in directory.iterdir()] == ["taken"]
        else:
            assert status == 0 or (status == 1 and "not finite" in err)
        outcomes[status] += 1
        monkeypatch.chdir(tmp_path)
        shutil.rmtree(directory)

    check()
    print(json.dumps({"trained": outcomes[0], "refused": outcomes[2], "not finite": outcomes[1]}))
    assert outcomes[0] > 60 and outcomes[2] > 60


def test_a_resumed_run_plays_other_games_than_before(script, tmp_path):
    args = script.Args(env_id="CartPole-v1", total_timesteps=1280, stop_at=128, **SMALL)
    seeds = []
    for _ in range(3):
        envs = make_envs("CartPole-v1", 4)
        reset = envs.reset
        envs.reset = lambda *, seed, reset=reset: seeds.extend(seed) or reset(seed=seed)
        run = script.RunDirectory(str(tmp_path))
        script.train(args, envs, run, run.load(script.Args) if seeds else None)
        os.close(run.lock)
    assert len(set(seeds)) == len(seeds) == 12


def test_a_checkpoint_that_breaks_off_leaves_the_one_before_it(script, tmp_path, monkeypatch, capfd):
    args = script.Args(env_id="CartPole-v1", total_timesteps=1280, stop_at=128, **SMALL)
    run = script.RunDirectory(str(tmp_path))
    script.train(args, make_envs("CartPole-v1", 4), run)
    whole = (tmp_path / "checkpoint.pt").read_bytes()

    def break_off(state, file):
        file.write(whole[:1000])
        assert (tmp_path / "checkpoint.pt").read_bytes() == whole  # a process that is killed now leaves it so
        raise OSError("No space left on device")

    monkeypatch.setattr(torch, "save", break_off)
    run.save({**run.load(script.Args), "iteration": 2})
    assert (tmp_path / "checkpoint.pt").read_bytes() == whole and run.failed
    assert "No space left on device; the run goes on" in capfd.readouterr().err
