"""An environment is a program of somebody else's: it forks, takes signals, changes directories, and fails late."""

import shlex
import signal
import sys

import pytest

from conftest import checkpoint_of, flags_of, open_run, reproducible, run_dir_in, scalars, train
from wrappers import make_envs

SIZES = {"num_envs": 2, "num_steps": 16, "threads": 1}


def flags(env: str, **more) -> list[str]:
    return flags_of(env_id=f"tiny_envs:{env}-v0", **{**SIZES, "total_timesteps": 320, "eval_episodes": 2, **more})


def test_a_forked_child_ends_by_its_signal_and_the_run_goes_on(script, start):
    ended = start(script, *flags("Forks")).end()
    assert (ended.status, ended.err) == (0, "") and ended.out.startswith("2 games at step 320")


def test_a_signal_that_an_environment_took_still_ends_the_run(script, tmp_path, start):
    process = start(script, *flags("TakesSignals", total_timesteps=10**9))
    process.wait_for((tmp_path / "step-100").exists)
    process.send_signal(signal.SIGTERM)
    assert process.end().status == 128 + signal.SIGTERM
    assert checkpoint_of(run_dir_in(tmp_path / "runs"))["global_step"] > 0


@pytest.mark.parametrize(("env", "said"), [("Raises", "RuntimeError: simulator lost"), ("Exits", "SystemExit:")])
def test_an_environments_failure_costs_no_whole_iteration(script, env, said, tmp_path, call_main):
    """Step 100 of an environment lies in the seventh rollout of 16 steps."""
    status, out, err = call_main(script, *flags(env))
    run_dir = run_dir_in(tmp_path / "runs")
    command = shlex.join([sys.executable, script.__file__, "--resume", str(run_dir)])
    assert (status, out) == (1, "")
    assert err == f"tiny_envs:{env}-v0 failed with {said}\nStopped; continue with: {command}\n"
    assert checkpoint_of(run_dir)["global_step"] == 6 * 32 == scalars(run_dir)["losses/kl"][-1][0]


def test_a_film_that_fails_is_reported_and_the_training_happens(script, tmp_path, call_main):
    ended = call_main(script, *flags("RendersNoMore"), "--capture-video")
    assert ended.status == 1 and ended.err.count("the video cannot be written") == ended.err.count("\n") == 1
    assert ended.out.startswith("2 games at step 320") and not list(tmp_path.glob("runs/*/videos/*"))


def test_an_environment_that_does_not_close_is_reported(script, call_main):
    ended = call_main(script, *flags("DoesNotClose"))
    assert ended.status == 0 and ended.out.startswith("2 games at step 320")
    assert ended.err.count("could not be closed (RuntimeError: already gone)") == ended.err.count("\n") == 2


def test_a_directory_that_an_environment_leaves_stays_the_runs(script, tmp_path, call_main, monkeypatch):
    start = tmp_path / "a" / "b" / "c" / "d" / "e" / "f" / "g" / "h"  # it goes up once for each copy
    start.mkdir(parents=True)
    monkeypatch.chdir(start)
    assert call_main(script, *flags("Leaves")).status == 0
    assert checkpoint_of(run_dir_in(start / "runs"))["global_step"] == 320


def test_global_generators_and_spaces_are_seeded(script, tmp_path, call_main):
    for name in ("first", "again"):
        assert call_main(script, *flags("DrawsGlobally", eval_episodes=0), "--log-dir", name).status == 0
    first, again = (reproducible(scalars(run_dir_in(tmp_path / name))) for name in ("first", "again"))
    assert first == again


def test_the_old_interface_of_a_step_is_refused(script, tmp_path, call_main):
    status, out, err = call_main(script, *flags("IsOld"))
    assert (status, out) == (2, "") and err.count("\n") == 1 and "it cannot be built: " in err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(("roms", "said"), [("none", "doesn't exist"), ("wrong", "does not match")])
def test_roms_that_are_missing_or_others_are_refused(script, roms, said, tmp_path, call_main, monkeypatch):
    (tmp_path / "wrong").mkdir()
    (tmp_path / "wrong" / "pong.bin").write_bytes(bytes(2048))
    monkeypatch.setenv("ALE_ROMS_DIR", str(tmp_path / roms))
    ended = call_main(script, "--env-id", "Pong")
    assert ended.status == 2 and ended.err.count("\n") == 1 and said in ended.err
    assert not (tmp_path / "runs").exists()


def test_a_rollout_that_memory_cannot_hold_is_refused_with_its_size(script, tmp_path, call_main):
    sizes = flags("ShowsMuch", num_steps=500_000, total_timesteps=10**6)
    status, out, err = call_main(script, *sizes)
    assert (status, out) == (2, "") and err.startswith("--num-steps 500000: a rollout's observations take 3,725 GiB, ")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("code", ["from wrappers import Mine", "import wrappers; wrappers.Mine"])
def test_a_users_file_that_has_a_taken_name_is_told_so(script, code, tmp_path, call_main, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "wrappers.py").write_text("class Mine: pass")
    (tmp_path / "my_envs.py").write_text(code)
    ended = call_main(script, "--env-id", "my_envs:Any-v0")
    assert ended.status == 2 and ended.err.endswith("; rename yours, this project has one\n")


def test_an_environment_that_can_only_exist_once_is_evaluated_and_filmed(script, tmp_path, call_main):
    trained = call_main(script, *flags("ExistsOnce", num_envs=1))
    assert (trained.status, trained.err) == (0, "")
    again = call_main(script, *flags_of(evaluate=run_dir_in(tmp_path / "runs"), eval_episodes=2), "--capture-video")
    assert (again.status, again.err) == (0, "") and again.out == trained.out
    films = [path.name for path in tmp_path.glob("runs/*/videos/*")]
    assert films == ["step_320_score_9.mp4"]  # its tenth step ends a game; building it has taken one


def test_event_files_that_are_not_the_runs_stay_as_they_are(script, tmp_path):
    sizes = {"env_id": "CartPole-v1", **SIZES}
    train(script, tmp_path, **sizes, total_timesteps=128, stop_at=64)
    (events,) = tmp_path.glob("events.*")
    copies = [events.with_name(name) for name in (events.name + ".bak", "events.out.tfevents.1700000000.other.1.0")]
    for copy in copies:
        copy.write_bytes(events.read_bytes())
    args = script.Args(**sizes, total_timesteps=128)
    with open_run(script, tmp_path) as run:
        script.train(args, make_envs(args.env_id, args.num_envs), run, run.load(script.Args))
    assert {copy.read_bytes() for copy in copies} == {events.read_bytes()}
