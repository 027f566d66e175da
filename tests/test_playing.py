"""Playing without learning: evaluation, videos, and that neither changes what is learnt."""

import csv
import json
import os
import re
import shlex
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from gymnasium.vector import VectorWrapper

import bookkeeping
import tiny_envs
from bookkeeping import play, record_game
from conftest import (
    SHORT_CARTPOLE,
    SMALL,
    TINY_PIXELS,
    checkpoint_of,
    flags_of,
    open_run,
    reproducible,
    run_dir_in,
    scalars,
    train,
)
from wrappers import env_seeds, make_envs

CARTPOLE = {"env_id": "CartPole-v1", **SMALL}
RENDERED = "tiny_envs:RenderedPixels-v0"


def agent_for(script, env_id: str):
    torch.manual_seed(1)
    envs = make_envs(env_id, 1)
    return script.Agent(envs.single_observation_space.shape, int(envs.single_action_space.n))


def policy_for(script, env_id: str, seed: int = 1):
    return script.make_policy(agent_for(script, env_id), seed)


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
    ("num_games", "scores"), [(4, [0, 1, 2, 3]), (6, [0, 1, 2, 3, 0, 1]), (9, [0, 1, 2, 3] * 2 + [0])]
)
def test_every_environment_plays_its_share_however_short_its_games(script, num_games, scores):
    envs = LastsAsLongAsItsNumber(make_envs("CartPole-v1", 4))
    games = play(policy_for(script, "CartPole-v1"), envs, num_games, seed=[1, 1])
    assert [score for score, _ in games] == scores
    assert [length for _, length in games] == [2**score for score in scores]


@pytest.mark.parametrize(
    "env_id",
    [
        RENDERED,
        pytest.param(SHORT_CARTPOLE, marks=pytest.mark.slow),
        pytest.param("Breakout", marks=pytest.mark.slow),
    ],
)
def test_training_is_the_same_with_and_without_videos_and_evaluation(script, env_id, tmp_path, monkeypatch, call_main):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # pygame complains without it if there is no desktop
    flags = flags_of(env_id=env_id, num_envs=2, num_steps=16, total_timesteps=128, update_epochs=1, threads=1)
    logged = []
    for name, extra in (("with", ["--capture-video", "--eval-episodes", "3"]), ("without", ["--eval-episodes", "0"])):
        ended = call_main(script, *flags, *extra, "--log-dir", name)
        assert (ended.status, ended.err) == (0, "")
        run_dir = run_dir_in(tmp_path / name)
        points = scalars(run_dir)
        assert ("eval/mean" in points) == (name == "with")
        assert (run_dir / "videos").exists() == (name == "with")
        logged.append({tag: p for tag, p in reproducible(points).items() if not tag.startswith("eval/")})
    assert logged[0] == logged[1]
    videos = [path.name.split("_")[1] for path in tmp_path.glob("with/*/videos/*.mp4")]
    assert sorted(videos, key=int) == ["0", "32", "64", "96", "128"]  # the start, the quarters and the end


def test_a_video_of_atari_shows_the_game_that_the_agent_plays(script, tmp_path):
    """Its screens, made grey and small as ale-py does it, are what the agent sees, and the last one after that."""
    path, policy, observations = tmp_path / "game.mp4", policy_for(script, "Breakout"), []
    envs = make_envs("Breakout", 1, video=str(path))
    ((_, length),) = play(lambda obs: observations.append(obs[0, -1].copy()) or policy(obs), envs, 1, seed=[3, 2])
    envs.close()
    screens = screens_of(path)
    assert len(screens) == length + 1 == len(observations) + 1
    assert screens[0].shape == (210, 160, 3)
    small = [cv2.cvtColor(screen, cv2.COLOR_RGB2GRAY) for screen in screens]
    small = [cv2.resize(screen, (84, 84), interpolation=cv2.INTER_AREA).astype(int) for screen in small]
    in_step, late = (
        [np.abs(screen - observation).mean() for screen, observation in zip(shown, observations)]
        for shown in (small, small[5:])
    )
    assert max(in_step) < np.mean(late)  # VP9 loses a little, five agent steps are more


def test_what_cannot_be_rendered_is_refused_before_a_run_begins(script, tmp_path, monkeypatch, call_main):
    status, _, said = call_main(script, "--env-id", TINY_PIXELS, "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "it cannot be rendered" in said
    monkeypatch.setattr(tiny_envs.RenderedPixels, "render", lambda self: None)
    status, _, said = call_main(script, "--env-id", RENDERED, "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "no video can be made of it" in said
    monkeypatch.setitem(sys.modules, "pygame", None)
    status, _, said = call_main(script, "--env-id", "CartPole-v1", "--capture-video")
    assert status == 2 and said.count("\n") == 1 and "pygame is not installed" in said
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_evaluated_and_the_run_goes_on_after_it(script, tmp_path, call_main):
    stopped = call_main(script, *flags_of(**CARTPOLE, total_timesteps=512, stop_at=256))
    assert stopped[:2] == (0, "")  # a run that stops on its way is not evaluated
    run_dir = run_dir_in(tmp_path / "runs")
    again = [call_main(script, "--evaluate", str(run_dir), "--eval-episodes", "5") for _ in range(2)]
    assert again[0].status == 0 and again[0] == again[1]
    with open(run_dir / "eval.csv") as file:
        rows = list(csv.DictReader(file))
    assert [(int(row["step"]), int(row["game"])) for row in rows] == [(256, game) for game in (1, 2, 3, 4, 5)]
    played = np.array([float(row["score"]) for row in rows[:5]])
    expected = [played.mean(), np.std(played, ddof=1), np.median(played), played.min(), played.max()]
    logged = scalars(run_dir)
    for name, value in zip(("mean", "std", "median", "min", "max"), expected):
        assert logged[f"eval/{name}"] == [(256, pytest.approx(value))] * 2
        assert float(re.search(rf" {name} (\S+)", again[0].out)[1]) == pytest.approx(value, rel=0.005)
    resumed = call_main(script, "--resume", str(run_dir))
    assert (resumed.status, resumed.err) == (0, "") and resumed.out.startswith("10 games at step 512:")
    assert [step for step, _ in scalars(run_dir)["eval/mean"]] == [256, 256, 512]


def test_an_evaluated_run_is_rid_of_points_after_its_checkpoint(script, tmp_path, call_main):
    call_main(script, *flags_of(**CARTPOLE, total_timesteps=1280, stop_at=256))
    run_dir = run_dir_in(tmp_path / "runs")
    kept = checkpoint_of(run_dir)
    call_main(script, "--resume", str(run_dir), "--stop-at", "512")
    # As if the process had been killed after the checkpoint that it writes at its start
    sizes = {path.name: kept["event_files"].get(path.name, 0) for path in run_dir.glob("events.*.[0-9]*")}
    torch.save({**kept, "event_files": sizes}, run_dir / "checkpoint.pt")
    assert call_main(script, "--evaluate", str(run_dir), "--eval-episodes", "2").status == 0
    assert call_main(script, "--resume", str(run_dir), "--stop-at", "640")[:2] == (0, "")
    logged = scalars(run_dir)
    assert [step for step, _ in logged["charts/learning_rate"]] == [128, 256, 384, 512, 640]
    assert [step for step, _ in logged["eval/mean"]] == [256]


def test_a_signal_ends_an_evaluation_between_two_agent_steps(script, tmp_path, start):
    """A million games without an end are not waited for; how to play them later is said."""
    flags = {"total_timesteps": 128, "eval_episodes": 1_000_000}
    process = start(script, *flags_of(**{**CARTPOLE, "env_id": "tiny_envs:Endless-v0"}, **flags))
    process.wait_for((tmp_path / "step-100").exists)  # of a game of the evaluation: the training has 32 steps a game
    process.send_signal(signal.SIGTERM)
    status, out, said = process.end()
    run_dir = run_dir_in(tmp_path / "runs")
    assert (status, out) == (128 + signal.SIGTERM, "") and said.endswith(f"--evaluate {run_dir}\n")
    assert checkpoint_of(run_dir)["global_step"] == 128 and not (run_dir / "eval.csv").exists()


def test_games_that_do_not_end_are_left_out(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steps = []
    assert play(lambda obs: steps.append(1) or np.zeros(2, int), make_envs("tiny_envs:Endless-v0", 2), 2, [1, 1]) == []
    assert len(steps) == 27_000


def test_the_run_directory_says_how_to_repeat_the_run(script, tmp_path, call_main):
    """Its command, run again, logs the same numbers."""
    call_main(script, *flags_of(**CARTPOLE, total_timesteps=256, gamma=0.9), "--no-norm-adv")
    run_dir = run_dir_in(tmp_path / "runs")
    about = json.loads((run_dir / "args.json").read_text())
    assert about["started_at_step"] == 0
    assert about["args"]["gamma"] == 0.9 and about["args"]["norm_adv"] is False
    assert about["provenance"]["torch"].startswith("2.13.0") and about["provenance"]["commit"]
    python, name, *words = shlex.split(about["command"])
    assert (python, name) == ("python", Path(script.__file__).name)
    assert call_main(script, *words, "--log-dir", "again").status == 0
    assert reproducible(scalars(run_dir)) == reproducible(scalars(run_dir_in(tmp_path / "again")))


def test_a_log_file_gets_a_line_a_minute_and_a_terminal_one_line(script, monkeypatch, capfd):
    clock = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    args, line = script.Args(num_envs=10, num_steps=10, total_timesteps=2000), bookkeeping.StatusLine()
    for clock[0] in range(0, 200, 10):
        line.show(args, clock[0] // 10, sps=50.0, last_scores=[1.0, 2.0])
    assert capfd.readouterr().err == "".join(
        f"step {step} of 2,000, 50 SPS, score 1.5, 0:00:{left} left\n"
        for step, left in (("600", "28"), ("1,200", "16"), ("1,800", "04"))
    )
    monkeypatch.setattr(os, "isatty", lambda descriptor: descriptor == 2)
    monkeypatch.setattr(os, "get_terminal_size", lambda descriptor: os.terminal_size((20, 24)))  # standard error's
    line.show(args, 19, sps=50.0, last_scores=[])
    bookkeeping.print_message("10 games", descriptor=1)  # into a file
    assert capfd.readouterr() == ("10 games\n", "\r\x1b[Kstep 1,900 of 2,000")


def test_a_game_of_an_evaluation_has_its_number_and_its_seed(script, tmp_path, call_main):
    train(script, tmp_path / "run", **CARTPOLE, total_timesteps=128)
    table, played = tmp_path / "run" / "eval.csv", []
    table.write_text("step,game,score,length\n64,1,9.0,9\n128,1,9.0,9\n")  # an older run's, whose seed is not known
    for num_games, seed in ((10, 1), (3, 1), (10, 2)):
        assert call_main(script, *flags_of(evaluate="run", eval_episodes=num_games, seed=seed)).status == 0
        with open(table, encoding="utf-8") as file:
            played.append([tuple(row.values()) for row in csv.DictReader(file)])
    older, *games = played[0]
    assert older == ("64", "", "1", "9.0", "9")
    assert [row[:3] for row in games] == [("128", "1", str(number)) for number in range(1, 11)]
    assert played[1] == played[0] == played[2][:11]
    others = played[2][11:]
    assert [row[:3] for row in others] == [("128", "2", str(number)) for number in range(1, 11)]
    assert [row[3:] for row in others] != [row[3:] for row in games]


def test_what_standard_error_cannot_take_does_not_end_the_run():
    """Its reader is gone, as after `2>&1 | head`."""
    reader, writer = os.pipe()
    os.close(reader)
    bookkeeping.print_message("to nobody", descriptor=writer)
    os.close(writer)


@pytest.mark.thesis("Agent")
def test_an_evaluation_draws_its_actions_from_the_policy(script):
    """Of a policy that takes action 1 three times in four, whatever it sees."""
    agent, envs, actions = agent_for(script, "CartPole-v1"), make_envs("CartPole-v1", 4), []
    with torch.no_grad():
        agent.actor[-1].weight.zero_()
        agent.actor[-1].bias.copy_(torch.tensor([1.0, 3.0]).log())
    step = envs.step
    envs.step = lambda given: actions.extend(given) or step(given)
    play(script.make_policy(agent, 1), envs, 40, seed=[1, 1])
    assert len(actions) > 300 and 0.65 < np.mean(actions) < 0.85


def test_evaluations_and_films_play_other_games_than_the_training(script, tmp_path, monkeypatch):
    args = script.Args(env_id=RENDERED, threads=1, eval_episodes=1)
    policy, seeds = policy_for(script, RENDERED), []
    monkeypatch.setattr(
        bookkeeping,
        "play",
        lambda policy, envs, num_games, seed, stop: seeds.append(seed) or envs.reset() and [(1.0, 1)],
    )
    with open_run(script, tmp_path) as run:
        bookkeeping.evaluate(args, policy, run, 0, bookkeeping.StopSignal())
        record_game(args, policy, run, 0, bookkeeping.StopSignal())
        assert len(seeds) == 2 and not run.write_errors
    numbers = [number for seed in (args.seed, *seeds) for number in env_seeds(seed, 8)]
    assert len(set(numbers)) == 3 * 8
