"""Playing without learning: evaluation, videos, and that neither changes what is learnt."""

import csv
import json
import os
import resource
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from gymnasium.vector import VectorWrapper

import tiny_envs
from conftest import MEASURED_IN_SECONDS, ONE_IN_THE_PLAIN_RUN, ROOT, SHORT_CARTPOLE, TINY_PIXELS, run_script, scalars
from wrappers import RecordVideo, env_seeds, make_envs

SMALL = ["--num-envs", "4", "--num-steps", "32", "--threads", "1"]


@pytest.fixture(params=ONE_IN_THE_PLAIN_RUN, ids=["acppo", "ppo"])
def script(request):
    return request.param


def agent_for(script, env_id: str):
    torch.manual_seed(1)
    envs = make_envs(env_id, 1)
    return script.Agent(envs.single_observation_space.shape, int(envs.single_action_space.n))


def screens_of(path: Path) -> list[np.ndarray]:
    """Returns the frames of a video, RGB."""
    video, screens = cv2.VideoCapture(str(path)), []
    while (frame := video.read())[0]:
        screens.append(cv2.cvtColor(frame[1], cv2.COLOR_BGR2RGB))
    return screens


class LastsAsLongAsItsNumber(VectorWrapper):
    """Ends every game of environment n after 2ⁿ steps, with the score n."""

    def reset(self, *, seed=None, options=None):
        self.steps = np.zeros(self.num_envs, int)
        return self.env.reset(seed=seed)

    def step(self, actions):
        obs, rewards, *_ = self.env.step(actions)
        self.steps += 1
        over = self.steps % 2 ** np.arange(self.num_envs) == 0
        infos = {"_episode": over, "episode": {"r": np.arange(self.num_envs), "l": 2 ** np.arange(self.num_envs)}}
        return obs, rewards, over, np.zeros_like(over), infos


@pytest.mark.parametrize(
    ("num_games", "scores"), [(4, [0, 1, 2, 3]), (6, [0, 0, 1, 1, 2, 3]), (9, [0] * 3 + [1] * 2 + [2] * 2 + [3] * 2)]
)
def test_every_environment_plays_its_share_however_short_its_games(script, num_games, scores):
    envs = LastsAsLongAsItsNumber(make_envs("CartPole-v1", 4))
    games = script.play(agent_for(script, "CartPole-v1"), envs, num_games, seed=[1, 1])
    assert [score for score, _ in games] == scores
    assert [length for _, length in games] == [2**score for score in scores]


def test_games_are_repeated_by_their_seed_and_leave_torchs_generator_alone(script):
    agent = agent_for(script, "CartPole-v1")
    before = torch.get_rng_state()
    first, again, other = (
        script.play(agent, make_envs("CartPole-v1", 3), 9, seed) for seed in ([1, 1], [1, 1], [2, 1])
    )
    assert first == again != other
    assert torch.equal(before, torch.get_rng_state())
    assert not set(env_seeds([1, 1], 8)) & set(env_seeds(1, 8))  # other games than those of the training


@pytest.mark.parametrize(
    "env_id",
    [
        "tiny_envs:RenderedPixels-v0",
        pytest.param(SHORT_CARTPOLE, marks=pytest.mark.slow),
        pytest.param("Breakout", marks=pytest.mark.slow),
    ],
)
def test_training_is_the_same_with_and_without_videos_and_evaluation(script, env_id, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # pygame complains without, where there is no desktop
    flags = ["--env-id", env_id, "--total-timesteps", "512", *SMALL]
    logged = []
    for name, extra in (("with", ["--capture-video", "--eval-episodes", "3"]), ("without", ["--eval-episodes", "0"])):
        (tmp_path / name).mkdir()
        run = run_script(script, *flags, *extra, cwd=tmp_path / name)
        assert (run.returncode, run.stderr) == (0, "")
        (run_dir,) = (tmp_path / name / "runs").iterdir()
        points = scalars(run_dir)
        assert ("eval/mean" in points) == (name == "with")
        assert (run_dir / "videos").exists() == (name == "with")
        logged.append({tag: p for tag, p in points.items() if not tag.startswith((*MEASURED_IN_SECONDS, "eval/"))})
    assert logged[0] == logged[1]
    videos = [path.name.split("_")[1] for path in (tmp_path / "with").glob("runs/*/videos/*.webm")]
    assert sorted(videos, key=int) == ["0", "128", "256", "384", "512"]  # the start, the quarters and the end


def test_a_video_of_atari_shows_the_game_that_the_agent_plays(script, tmp_path):
    """Its screens, made grey and small as ale-py does it, are the observations; its name has the sum of raw rewards."""
    path = tmp_path / "game.webm"
    envs = make_envs("Breakout", 1, video=str(path))
    base = envs
    while not isinstance(base, RecordVideo):
        base = base.env
    observations, raw_rewards, step, reset = [], [], base.step, base.reset

    def watched_reset(**given):
        result = reset(**given)
        observations.append(result[0][0, -1])
        return result

    def watched_step(actions):
        result = step(actions)
        over = result[2][0] or result[3][0]
        observations.append((result[4]["final_obs"] if over else result[0])[0, -1])
        raw_rewards.append(result[1][0])
        return result

    base.reset, base.step = watched_reset, watched_step
    ((score, length),) = script.play(agent_for(script, "Breakout"), envs, 1, seed=[3, 2])
    envs.close()
    screens = screens_of(path)
    assert sum(raw_rewards) == score and len(raw_rewards) == length
    assert len(screens) == length + 1 == len(observations)
    assert screens[0].shape == (210, 160, 3)
    small = [cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY) for screen in screens]
    small = [cv2.resize(screen, (84, 84), interpolation=cv2.INTER_AREA).astype(int) for screen in small]
    in_step, late = (
        [np.abs(screen - observation).mean() for screen, observation in zip(shown, observations)]
        for shown in (small, small[5:])
    )
    assert max(in_step) < np.mean(late)  # VP9 loses a little, five agent steps are more


def test_what_cannot_be_rendered_is_refused_before_a_run_begins(script, tmp_path, monkeypatch, call_main):
    monkeypatch.chdir(tmp_path)
    status, _, said = call_main(script, "--env-id", TINY_PIXELS, "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "it cannot be rendered" in said
    monkeypatch.setattr(tiny_envs.RenderedPixels, "render", lambda self: None)
    status, _, said = call_main(script, "--env-id", "tiny_envs:RenderedPixels-v0", "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "no video can be made of it" in said
    monkeypatch.setitem(sys.modules, "pygame", None)
    status, _, said = call_main(script, "--env-id", "CartPole-v1", "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "pygame is not installed" in said
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_evaluated_and_the_run_goes_on_after_it(script, tmp_path):
    flags = ["--env-id", "CartPole-v1", "--total-timesteps", "512", "--stop-at", "256", *SMALL]
    assert run_script(script, *flags, cwd=tmp_path).stdout == ""  # a run that stops on its way is not evaluated
    (run_dir,) = (tmp_path / "runs").iterdir()
    again = [run_script(script, "--evaluate", str(run_dir), "--eval-episodes", "5", cwd=tmp_path) for _ in range(2)]
    assert [run.returncode for run in again] == [0, 0] and again[0].stdout == again[1].stdout
    with open(run_dir / "eval.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["step"]), int(row["game"])) for row in rows] == [(256, game) for game in (1, 2, 3, 4, 5)] * 2
    played = np.array([float(row["score"]) for row in rows[:5]])
    expected = [played.mean(), np.std(played, ddof=1), np.median(played), played.min(), played.max()]
    logged = scalars(run_dir)
    for name, value in zip(("mean", "std", "median", "min", "max"), expected):
        assert logged[f"eval/{name}"] == [(256, pytest.approx(value))] * 2
        assert f"{name} {value:.1f}" in again[0].stdout
    resumed = run_script(script, "--resume", str(run_dir), cwd=tmp_path)
    assert (resumed.returncode, resumed.stderr) == (0, "") and resumed.stdout.startswith("10 games at step 512:")
    assert [step for step, _ in scalars(run_dir)["eval/mean"]] == [256, 256, 512]


def test_a_killed_run_that_is_evaluated_is_still_rid_of_what_it_logged_after_its_checkpoint(script, tmp_path):
    flags = ["--env-id", "CartPole-v1", "--total-timesteps", "1280", *SMALL]
    assert run_script(script, *flags, "--stop-at", "256", cwd=tmp_path).returncode == 0
    (run_dir,) = (tmp_path / "runs").iterdir()
    kept = (run_dir / "checkpoint.pt").read_bytes()
    assert run_script(script, "--resume", str(run_dir), "--stop-at", "512", cwd=tmp_path).returncode == 0
    (run_dir / "checkpoint.pt").write_bytes(kept)  # as if the process had been killed before its next checkpoint
    assert run_script(script, "--evaluate", str(run_dir), "--eval-episodes", "2", cwd=tmp_path).returncode == 0
    assert run_script(script, "--resume", str(run_dir), "--stop-at", "640", cwd=tmp_path).returncode == 0
    logged = scalars(run_dir)
    assert [step for step, _ in logged["charts/learning_rate"]] == [128, 256, 384, 512, 640]
    assert [step for step, _ in logged["eval/mean"]] == [256]


def test_a_signal_ends_an_evaluation_at_once(script, tmp_path):
    flags = ["--env-id", "tiny_envs:Endless-v0", "--total-timesteps", "128", *SMALL]
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tests")}
    process = subprocess.Popen([sys.executable, script.__file__, *flags], cwd=tmp_path, env=environment)
    deadline = time.monotonic() + 120
    while not any(torch.load(path)["iteration"] for path in tmp_path.glob("runs/*/checkpoint.pt")):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    time.sleep(2)  # its games, of 27,000 steps each, take longer
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=10) == -signal.SIGTERM


def test_games_that_do_not_end_are_left_out(script, monkeypatch):
    envs = make_envs("tiny_envs:Endless-v0", 2)
    steps = []
    monkeypatch.setattr(script, "act", lambda agent, obs, generator: (steps.append(1) or torch.zeros(2).long(), 0, 0))
    agent = agent_for(script, "tiny_envs:Endless-v0")
    assert script.play(agent, envs, 2, seed=[1, 1]) == []
    assert len(steps) == 27_000


def test_the_video_of_a_game_that_does_not_end_has_no_score(script, tmp_path, monkeypatch):
    args = script.Args(env_id="tiny_envs:RenderedPixels-v0", log_dir=str(tmp_path), threads=1)
    run = script.RunDirectory.make(args)
    monkeypatch.setattr(script, "play", lambda agent, envs, num_games, seed: envs.reset() and [])
    script.record_game(args, agent_for(script, args.env_id), run, global_step=7)
    assert [path.name for path in tmp_path.glob("*/videos/*")] == ["step_7_without_end.webm"] and not run.failed


@pytest.mark.slow
def test_a_video_that_the_disk_has_no_room_for_is_reported(script, tmp_path):
    flags = ["--env-id", "Breakout", "--total-timesteps", "128", *SMALL, "--capture-video", "--eval-episodes", "0"]
    run = subprocess.run(
        [sys.executable, script.__file__, *flags, "--checkpoint-minutes", "60"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (8_000, 8_000)),
    )
    assert run.returncode == 1 and run.stderr.count("\n") == 1 and "the run goes on" in run.stderr
    assert not list(tmp_path.glob("runs/*/videos/*score*"))


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--evaluate", "nowhere"], "--evaluate nowhere: No such file or directory"),
        (["--evaluate", "RUN", "--resume", "RUN"], "give either this or --resume"),
        (["--evaluate", "RUN", "--eval-episodes", "0"], "give --eval-episodes above 0, too"),
        (["--eval-episodes", "-1"], "--eval-episodes -1: give a whole number from 0"),
    ],
)
def test_an_evaluation_that_cannot_be_is_refused(script, flags, said, tmp_path, monkeypatch, call_main):
    monkeypatch.chdir(tmp_path)
    args = script.Args(env_id="CartPole-v1", num_envs=2, num_steps=8, total_timesteps=16, threads=1)
    run = script.RunDirectory.make(args)
    script.train(args, make_envs("CartPole-v1", 2), run)
    os.close(run.lock)
    (run_dir,) = (tmp_path / "runs").iterdir()
    status, _, err = call_main(script, *(str(run_dir) if flag == "RUN" else flag for flag in flags))
    assert status == 2 and err.count("\n") == 1 and said in err


def test_the_run_directory_says_how_to_repeat_the_run(script, tmp_path):
    """Its command, run again, logs the same numbers."""
    flags = ["--env-id", "CartPole-v1", "--total-timesteps", "256", "--no-norm-adv", "--gamma", "0.9", *SMALL]
    run_script(script, *flags, cwd=tmp_path)
    (run_dir,) = (tmp_path / "runs").iterdir()
    about = json.loads((run_dir / "args.json").read_text())
    assert about["started_at_step"] == 0
    assert about["args"]["gamma"] == 0.9 and about["args"]["norm_adv"] is False
    assert about["provenance"]["torch"].startswith("2.13.0") and len(about["provenance"]["commit"]) >= 16
    python, name, *words = shlex.split(about["command"])
    assert (python, ROOT / name) == ("python", Path(script.__file__))
    again = run_script(script, *words, "--log-dir", "again", cwd=tmp_path)
    assert again.returncode == 0
    (repeated,) = (tmp_path / "again").iterdir()
    first, second = (
        {tag: points for tag, points in scalars(path).items() if not tag.startswith(MEASURED_IN_SECONDS)}
        for path in (run_dir, repeated)
    )
    assert first == second


def test_a_log_file_gets_a_line_a_minute_and_a_terminal_one_line(script, tmp_path, monkeypatch, capfd):
    import wrappers

    clock = [0.0]
    monkeypatch.setattr(wrappers.time, "perf_counter", lambda: clock[0])
    line = wrappers.StatusLine()
    for clock[0] in range(0, 200, 10):
        line.show(f"at {clock[0]}", last=False)
    assert capfd.readouterr().err == "at 60\nat 120\nat 180\n"
    monkeypatch.setattr(wrappers.os, "isatty", lambda descriptor: True)
    line.show("a", last=False)
    line.show("b", last=True)
    clear = "\r\x1b[K"
    assert capfd.readouterr().err == f"{clear}a{clear}b\n"
    monkeypatch.setattr(sys, "stderr", None)  # as Python leaves it where the shell closed it: 2>&-
    line.show("c", last=True)
    assert capfd.readouterr().err == ""


def test_an_evaluation_draws_its_actions_from_the_policy(script):
    """Of a policy that takes action 1 three times in four, whatever it sees."""
    agent, envs, actions = agent_for(script, "CartPole-v1"), make_envs("CartPole-v1", 4), []
    with torch.no_grad():
        agent.actor[-1].weight.zero_()
        agent.actor[-1].bias.copy_(torch.tensor([1.0, 3.0]).log())
    step = envs.step
    envs.step = lambda given: actions.extend(given) or step(given)
    script.play(agent, envs, 40, seed=[1, 1])
    assert len(actions) > 300 and 0.65 < np.mean(actions) < 0.85


def test_evaluations_and_films_play_other_games_than_the_training(script, tmp_path, monkeypatch):
    args = script.Args(env_id="tiny_envs:RenderedPixels-v0", log_dir=str(tmp_path), threads=1, eval_episodes=1)
    run, agent, seeds = script.RunDirectory.make(args), agent_for(script, args.env_id), []
    monkeypatch.setattr(
        script, "play", lambda agent, envs, num_games, seed: seeds.append(seed) or envs.reset() and [(1.0, 1)]
    )
    script.evaluate(args, agent, run, {"args": vars(args), "event_files": {}, "global_step": 0})
    script.record_game(args, agent, run, global_step=0)
    assert len(seeds) == 2 and not run.failed
    numbers = [number for seed in (args.seed, *seeds) for number in env_seeds(seed, 8)]
    assert len(set(numbers)) == 3 * 8
