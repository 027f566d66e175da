"""The results: reading the logs, tables and figures, and the files that a call may touch."""

import itertools
import json
import math
import resource
import shutil
import subprocess
import sys
import time

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from torch.utils.tensorboard import SummaryWriter

from benchmark import claims, collect, figures, readme
from bookkeeping import EventFile
from conftest import ROOT

BATCH = 1024  # agent steps of an iteration


def make_arguments(variant: str, game: str, seed: int, iterations: int = 10, **more) -> dict:
    epsilons = {
        "acppo": {"clip_coef": 0.16, "c": 1.0},
        "mine": {"clip_coef": 0.2},
        "product": {"clip_coef": 0.1, "c": "inf"},
    }
    epsilon = epsilons.get(variant, {"clip_coef": 0.1}) if variant != "without" else {}
    sizes = {"total_timesteps": iterations * BATCH, "num_envs": 8, "num_steps": 128}
    return {"exp_name": variant, "env_id": game, "seed": seed, **sizes, **epsilon, **more}


def make_run(out, variant="ppo", game="CartPole-v1", seed=1, started=1, **columns):
    """Makes a run's directory as a script does: an event file with `columns`, a value an iteration, and args.json."""
    directory = out / "runs" / f"{game}__{variant}__{seed}__{started}"
    directory.mkdir(parents=True)
    log(directory, {collect.TAGS[column]: dict(enumerate(values, start=1)) for column, values in columns.items()})
    provenance = {"commit": "abc", "python": "3.12", "torch": "2.13.0", "machine": "a machine", "threads": 1}
    record = {"command": "ppo_atari.py", "args": make_arguments(variant, game, seed), "provenance": provenance}
    (directory / "args.json").write_text(json.dumps(record))
    return directory


def log(directory, points: dict[str, dict[int, float]]) -> None:
    """Writes an event file as a start of a run does: tag → iteration → value."""
    of_tags = ((tag, iteration, value) for tag, values in points.items() for iteration, value in values.items())
    EventFile(str(directory)).append([(iteration * BATCH, tag, value) for tag, iteration, value in of_tags])


def make_csvs(out, runs: dict[tuple, dict], iterations: int | None = None, bf16=()) -> None:
    """Writes the two CSVs: (variant, game, seed) → column → a value an iteration; columns not given are 0.1.

    Their schedule has as many iterations as the longest of them, or as `iterations` says.
    """
    rows, curves = [], []
    for (variant, game, seed), columns in runs.items():
        curve = pd.DataFrame({"games_ended": 100, **columns})
        curve = curve.reindex(columns=["games_ended", *collect.TAGS], fill_value=0.1)
        curve["step"] = BATCH * np.arange(1, len(curve) + 1)
        curves.append(curve.assign(variant=variant, game=game, seed=seed))
    total = iterations or max(map(len, curves))
    for key, curve in zip(runs, curves):
        arguments = make_arguments(*key, total, bf16=key in bf16)
        place = {"commit": "abc", "machine": "a machine", "threads": "1", "versions": "{}", "command": "ppo_atari.py"}
        row = {**dict(zip(collect.KEY, key)), **place, "steps": curve.step.max()}
        rows.append({**row, "total_timesteps": total * BATCH, "arguments": json.dumps(arguments)})
    out.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).reindex(columns=collect.RUN_COLUMNS).to_csv(out / "runs.csv", index=False)
    pd.concat(curves)[collect.CURVE_COLUMNS].to_csv(out / "curves.csv", index=False)


def make_stages(out, runs: dict[tuple, dict], iterations: int | None = None, bf16=(), **pair) -> list[claims.Stage]:
    make_csvs(out, runs, iterations, bf16)
    return claims.make_stages(*collect.read_csvs(out), **pair)


def make_pairs(out, differences: dict[str, list[float]], iterations: int = 2, **acppo) -> claims.Stage:
    """Returns the one stage of a pair for each final difference of scores, by game."""
    runs = {}
    for game, of_game in differences.items():
        for seed, difference in enumerate(of_game, start=1):
            runs["ppo", game, seed] = {"mean_return_100": [0, 10]}
            runs["acppo", game, seed] = {"mean_return_100": [0, 10 + difference], **acppo}
    (stage,) = make_stages(out, runs, iterations)
    return stage


def call(monkeypatch, *flags, command=figures) -> None:
    monkeypatch.setattr(sys, "argv", ["figures.py", *map(str, flags)])
    command.main()


def contents(directory) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def cells(markdown: str) -> list[list[str]]:
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


# ----------------------------------------------------------------------------------------------------- collect
def test_all_points_are_read(tmp_path):
    """By itself, TensorBoard's reader keeps 10,000 of them."""
    directory = make_run(tmp_path, kl=range(10_001))
    curve = collect.read_curve(collect.read_events(directory))
    assert list(curve.index) == [BATCH * i for i in range(1, 10_002)]
    assert list(curve.kl) == list(range(10_001))


def test_a_step_that_was_logged_twice_keeps_what_was_written_last_by_whatever_clock(tmp_path, monkeypatch):
    directory = make_run(tmp_path, kl=[1, 2, 3, 4])
    log(directory, {"losses/kl": {3: 30, 4: 40, 5: 50}, "losses/clipfrac": {5: 0.5}})
    monkeypatch.setattr(time, "time", lambda: 1.0)
    log(directory, {"losses/kl": {5: 55}})
    curve = collect.read_curve(collect.read_events(directory))
    assert list(curve.kl) == [1, 2, 30, 40, 55]
    assert curve.clipfrac.iloc[-1] == 0.5 and curve.clipfrac[:-1].isna().all()


def test_a_run_gives_a_row_and_its_iterations_with_six_digits(tmp_path):
    make_run(tmp_path, "acppo", seed=7, kl=[1 / 3, 1e-5 / 3], mean_return_100=[9, 10])
    collect.collect(tmp_path)
    run = pd.read_csv(tmp_path / "runs.csv").iloc[0]
    assert (run.variant, run.game, run.seed, run.steps, run.total_timesteps) == ("acppo", "CartPole-v1", 7, 2048, 10240)
    assert (run.commit, run.machine, run.threads) == ("abc", "a machine", 1)
    assert json.loads(run.versions) == {"python": "3.12", "torch": "2.13.0"}
    assert json.loads(run.arguments) == make_arguments("acppo", "CartPole-v1", 7)
    lines = (tmp_path / "curves.csv").read_text().splitlines()
    nothing = "," * (len(collect.CURVE_COLUMNS) - 6)
    assert lines[0].startswith("variant,game,seed,step,mean_return_100,kl,") and lines[0].endswith(",games_ended")
    assert lines[1:] == [f"acppo,CartPole-v1,7,{row}{nothing}0" for row in ("1024,9,0.333333", "2048,10,3.33333e-06")]


def test_the_last_evaluation_counts_by_itself(tmp_path):
    """A second one of the same agent begins with the games of the first, which eval.csv then holds twice."""
    directory = make_run(tmp_path, kl=[1], mean_return_100=[5])
    games = [(1, 10), (2, 20), (1, 10), (2, 20), (3, 60)]
    rows = "".join(f"1024,{number},{score},99\n" for number, score in games)
    (directory / "eval.csv").write_text(f"step,game,score,length\n{rows}")
    make_run(tmp_path, "acppo", kl=[1], mean_return_100=[5])
    collect.collect(tmp_path)
    runs = collect.read_csvs(tmp_path)[0].set_index("variant")
    assert list(runs.loc["ppo", collect.EVALUATION]) == [3, 30, pytest.approx(math.sqrt(700))]
    assert runs.loc["acppo", collect.EVALUATION].isna().all()
    assert cells(claims.evaluation_table(runs.reset_index()))[2:] == [["CartPole-v1", "ppo", "1", "30.0 ± 26.5", "3"]]


def test_games_are_counted_where_they_ended_and_starts_where_they_differ(tmp_path):
    directory = make_run(tmp_path, kl=[1, 2, 3])
    writer = SummaryWriter(str(directory), filename_suffix=".games")
    for step in (100, 1024, 1025, 1025, 3000):  # two games may end in one step
        writer.add_scalar("charts/episodic_return", 0.0, step)
    for commit, machine in (("abc", "one"), ("def", "one"), ("abc", "other")):
        writer.add_text("provenance", f"|name|value|\n|-|-|\n|commit|{commit}|\n|machine|{machine}|")
    writer.close()
    collect.collect(tmp_path)
    runs, curves = collect.read_csvs(tmp_path)
    assert list(curves.games_ended) == [2, 4, 5]
    assert (runs.commit[0], runs.machine[0], runs.threads[0]) == ("abc; def", "one; other", "unknown")


def test_runs_without_a_directory_keep_their_rows_and_found_ones_replace_theirs(tmp_path, capfd):
    first = make_run(tmp_path, seed=1, kl=[1, 2])
    make_run(tmp_path, seed=2, kl=[3])
    collect.collect(tmp_path)
    shutil.rmtree(first)
    log(tmp_path / "runs" / "CartPole-v1__ppo__2__1", {"losses/kl": {2: 4}})
    make_run(tmp_path, "acppo", kl=[5])
    collect.collect(tmp_path)
    assert capfd.readouterr().err == ""
    runs, curves = collect.read_csvs(tmp_path)
    assert list(zip(runs.variant, runs.seed, runs.steps)) == [("acppo", 1, 1024), ("ppo", 1, 2048), ("ppo", 2, 2048)]
    assert list(curves.kl) == [5, 1, 2, 3, 4]
    before = contents(tmp_path)
    collect.collect(tmp_path)
    assert contents(tmp_path) == before
    make_run(tmp_path, seed=1, kl=[6])
    collect.collect(tmp_path)
    assert list(collect.read_csvs(tmp_path)[1].kl) == [5, 6, 3, 4]
    assert capfd.readouterr().err == "ppo CartPole-v1 1: 1024 steps replace 2048\n"


def test_of_two_directories_of_a_run_the_one_that_got_further_counts(tmp_path, capfd):
    make_run(tmp_path, started=1, kl=[1, 1, 1])
    make_run(tmp_path, started=2, kl=[2, 2])
    collect.collect(tmp_path)
    assert list(collect.read_csvs(tmp_path)[1].kl) == [1, 1, 1]
    assert (
        capfd.readouterr().err
        == "ppo CartPole-v1 1: CartPole-v1__ppo__1__1 counts, CartPole-v1__ppo__1__2 got no further\n"
    )


def test_a_directory_that_is_no_run_is_left_out_and_said(tmp_path, capfd):
    make_run(tmp_path, kl=[1])
    (make_run(tmp_path, seed=2, kl=[1]) / "args.json").write_text("{")
    (make_run(tmp_path, seed=3, kl=[1]) / "args.json").unlink()
    make_run(tmp_path, seed=4)
    (make_run(tmp_path, seed=5, kl=[1]) / "args.json").write_text("[]")
    collect.collect(tmp_path)
    assert list(collect.read_csvs(tmp_path)[0].seed) == [1]
    said = capfd.readouterr().err.splitlines()
    assert len(said) == 4 and all("left out" in line for line in said)


# -------------------------------------------------------------------------------------------------- statistics
@pytest.mark.parametrize(
    ("values", "mean"),
    [([5], 5), ([1, 2], 1.5), ([100, 0, 1, 2], 1.5), ([0, 1, 2, 5, 100], (0.75 * 1 + 2 + 0.75 * 5) / 2.5)],
)
def test_the_interquartile_mean_weighs_borders_by_their_part_inside(values, mean):
    assert claims.interquartile_mean(np.array(values, dtype=float)) == pytest.approx(mean)


def test_the_interval_is_that_of_all_ways_to_redraw_seeds_within_games():
    strata = [np.array([0.1, 0.5, 0.4]), np.array([1.0, 3.0, 1.7])]
    ways = [list(itertools.product(values, repeat=3)) for values in strata]  # 27 × 27, equally likely
    means = [claims.interquartile_mean(np.array(one + other)) for one, other in itertools.product(*ways)]
    low, high = claims.bootstrap_interval(strata)
    assert np.mean(np.less(means, low - 1e-9)) < 0.03 and np.mean(np.less(means, low + 1e-9)) > 0.02
    assert np.mean(np.greater(means, high + 1e-9)) < 0.03 and np.mean(np.greater(means, high - 1e-9)) > 0.02
    assert (low, high) == claims.bootstrap_interval(strata)
    # Across games 0 and 10 would mix; within a game there is nothing to mix
    assert claims.bootstrap_interval([np.zeros(3), np.full(3, 10.0)]) == (5, 5)
    assert claims.bootstrap_interval([np.zeros(3), np.zeros(1)]) is None


def test_the_interval_of_three_pairs_a_game_excludes_no_difference_one_time_in_ten(monkeypatch):
    """For two equal algorithms a 95 % interval should do so one time in twenty; the text beside the claims says ten."""
    monkeypatch.setattr(claims, "DRAWS", 1000)
    generator = np.random.default_rng(1)
    intervals = [claims.bootstrap_interval(list(generator.standard_normal((5, 3)))) for _ in range(1000)]
    assert 0.08 < np.mean([low > 0 or high < 0 for low, high in intervals]) < 0.12


def test_finished_runs_are_compared_apart_from_beginnings_each_game_at_one_step(tmp_path):
    lengths = {("ppo", "Pong", 1): 100, ("acppo", "Pong", 1): 90, ("ppo", "Pong", 2): 88, ("acppo", "Pong", 2): 44}
    lengths |= {("ppo", "Pong", 3): 43, ("ppo", "Qbert", 1): 3}
    stages = make_stages(tmp_path, {key: {"kl": range(length)} for key, length in lengths.items()})
    finished, beginnings = stages
    assert (finished.name, beginnings.name) == ("finished", "beginnings")
    ends = {key: len(curve) for stage in stages for key, curve in stage.drawn.items()}
    assert {key: len(curve) for key, curve in finished.drawn.items()} == {
        ("ppo", "Pong", 1): 100,
        ("acppo", "Pong", 1): 90,
    }
    assert {key: list(curve.kl) for key, curve in finished.compared.items()} == dict.fromkeys(
        [("ppo", "Pong", 1), ("acppo", "Pong", 1)], list(range(90))
    )
    # The figures show them as far as the longest unfinished one, a finished one's first steps too
    assert ends == {**lengths, ("ppo", "Pong", 1): 88, ("acppo", "Pong", 1): 88}
    without_short = {key: 44 for key in lengths if key[1] == "Pong" and key[2] < 3} | {("ppo", "Qbert", 1): 3}
    assert {key: len(curve) for key, curve in beginnings.compared.items()} == without_short
    assert "In the figures alone, being shorter than half of their game's longest: Pong ppo 3." in figures.coverage(
        beginnings
    )
    assert "at 90 % to 100 % of a schedule of 102,400 agent steps. All in float32." in figures.coverage(finished)


def test_it_is_said_which_runs_are_in_bfloat16(tmp_path):
    keys = [("ppo", "Pong", 1), ("acppo", "Pong", 1), ("ppo", "Pong", 2)]
    (stage,) = make_stages(tmp_path, {key: {"kl": [1]} for key in keys}, bf16=keys[:2])
    said = "In bfloat16: Pong ppo 1, Pong acppo 1; the others in float32."
    assert said in figures.coverage(stage) and all(text.endswith(said) for text in figures.captions(stage).values())


def test_both_spike_rates_as_counted_by_hand(tmp_path):
    ppo = [1] * 93 + [9] * 2 + [20] * 5  # 99th percentile 20, median 1
    acppo = [1] * 97 + [30] * 3
    (stage,) = make_stages(tmp_path, {("ppo", "Pong", 1): {"kl": ppo}, ("acppo", "Pong", 1): {"kl": acppo}})
    margins = claims.find_margins(stage)
    assert margins["relative spikes"]["Pong"] == pytest.approx([0 - 0.03])
    assert margins["own spikes"]["Pong"] == pytest.approx([0.05 - 0.03])
    assert margins["KL"]["Pong"] == pytest.approx([math.log(2.11 / 1.87)])
    ppo_row, acppo_row = cells(claims.kl_table(stage))[2:]
    # The TV distance is 0.1: above PPO's 0.1 / 2, above AC-PPO's 0.16 / 2
    assert ppo_row == ["Pong", "ppo", "1", "102,400", "2.11", "1", "20", "20", "0.00%", "5.00%", "100.00%", "0.1000"]
    assert acppo_row[4:] == ["1.87", "1", "30", "30", "3.00%", "3.00%", "100.00%", "0.1000"]


def test_a_relative_spike_is_above_what_all_seeds_of_ppo_have(tmp_path):
    kl = {("ppo", "Pong", 1): [1] * 100, ("ppo", "Pong", 2): [1] * 90 + [9] * 10, ("acppo", "Pong", 1): [1] * 99 + [5]}
    (stage,) = make_stages(tmp_path, {key: {"kl": values} for key, values in kl.items()})
    assert claims.spike_limit(stage, "Pong") == 9
    assert claims.find_margins(stage)["relative spikes"]["Pong"] == [0]  # a 5 is one for seed 1 alone
    rows = cells(claims.kl_table(stage))[2:]
    assert [row[8:10] for row in rows] == [["0.00%", "0.00%"], ["0.00%", "0.00%"]]  # 5 and 9 are not above ten times 1
    assert rows[0][2:8] == ["2", "102,400", "1.4", "1", "9", "9"]


def test_progress_is_told_in_tenths_of_the_schedule(tmp_path):
    columns = {"mean_return_100": range(1000, 1020), "kl": [1, 3] * 9 + [4, 6]}
    (stage,) = make_stages(tmp_path, {("ppo", "Pong", 1): columns})
    header, _, score, kl = cells(claims.progress_table(stage))
    assert (header[2], header[-1]) == ("10 %", "100 %")
    assert score[1:4] == ["score", "1,001", "1,003"] and kl[1:] == ["KL", *["2"] * 9, "5"]


@pytest.mark.parametrize(("schedule", "told"), [(38, True), (40, True), (42, False)])
def test_progress_and_largest_kls_are_told_once_all_have_done_half_of_their_schedules(schedule, told, tmp_path):
    runs = {("ppo", "Pong", 1): {"mean_return_100": [7] * 19 + [8], "kl": 1}, ("acppo", "Pong", 1): {"kl": [1] * 20}}
    (stage,) = make_stages(tmp_path, runs, iterations=schedule)
    table = figures.stage_tables(stage)["kl"]
    assert not stage.final and ("of the schedule" in table) == ("× median" in table) == told
    score, kl = cells(claims.progress_table(stage))[2:4]
    rest = ["–"] * (5 if told else 6)  # a tenth that has not ended is left out, too
    assert score[1:] == ["score", *["7"] * (9 - len(rest)), "8" if schedule == 40 else "7", *rest]
    assert kl[1:] == ["KL", *["1"] * (10 - len(rest)), *rest]


def test_the_largest_kls_stand_beside_what_else_their_iteration_had(tmp_path):
    columns = {"kl": [1, 9, 3, 1, 1], "games_ended": [0, 2, 2, 5, 6], "learning_rate": [0.5, 0.4, 0.3, 0.2, 0.1]}
    columns["explained_variance"] = [math.nan, math.nan, 0.5, 0.25, 0.75]
    (stage,) = make_stages(tmp_path, {("ppo", "Pong", 1): columns})
    header, _, *rows = cells(claims.spikes_table(stage.compared, most=2))
    named = [dict(zip(header, row)) for row in rows]
    assert {row["run"] for row in named} == {"Pong ppo 1"}
    chosen = ("agent step", "KL", "× median", "learning rate", "explained variance", "games ended")
    assert [[row[name] for name in chosen] for row in named] == [
        ["2,048", "9", "9", "0.4", "–", "2"],
        ["3,072", "3", "3", "0.3", "0.5", "0"],
        ["their rank", "0.9", "0.9", "0.7", "0.667", "0.5"],  # 5 and 4 of 5; 4 and 3; 2 of 3; 3 and 1 of 4
        ["all: median", "1", "1", "0.3", "0.5", "1.5"],
    ]


@pytest.mark.parametrize(
    ("differences", "judged"),
    [
        ([1, 2, 3], "✓ 3 of 3"),
        ([-1, -2, -3], "✗ 0 of 3"),
        ([1, 2, -3], "? 2 of 3"),
        ([1, 2, 0], "? 2 of 3, 1 equal"),
        ([1, 2], "? 2 of 2"),
        ([-1], "? 0 of 1"),
        ([math.nan, 1, 1, 1], "✓ 3 of 3"),
    ],
)
def test_a_claim_holds_on_a_game_where_three_or_more_pairs_all_have_its_sign(differences, judged, tmp_path):
    header, _, score, *_ = cells(claims.claims_table(make_pairs(tmp_path, {"Pong": differences})))
    assert header == ["claim", "Pong", "across games"]
    assert score == ["AC-PPO's final score is above PPO's", judged, "–"]


@pytest.mark.parametrize(
    ("pong", "breakout", "judged"),
    [
        ([5, 6, 7], [1, 2, 3], "✓ holds"),
        ([-5, -6, -7], [-1, -2, -3], "✗ does not hold"),
        ([5, 6, 7], [-4, -5, -6], "? cannot be told apart with these runs"),
        ([5, 6, 7], [1, 2], "? cannot be told apart with these runs"),
        ([5, 6, 7], [1], "? cannot be told apart with these runs"),
    ],
)
def test_a_claim_is_judged_across_games_by_its_interval(pong, breakout, judged, tmp_path):
    stage = make_pairs(tmp_path, {"Pong": pong, "Breakout": breakout, "CartPole-v1": [9, 9, 9]})
    strata = [np.array(breakout) / (30.5 - 1.7), np.array(pong) / (14.6 + 20.7)]  # CartPole has no human score
    mean, interval = claims.interquartile_mean(np.concatenate(strata)), claims.bootstrap_interval(strata)
    shown = "no interval: one seed" if interval is None else "{:+.3f} to {:+.3f}".format(*interval)
    across = cells(claims.claims_table(stage))[2][-1]
    assert across == f"{judged}: {mean:+.3f} of human minus random score ({shown})"


def test_a_game_without_a_pair_leaves_the_claim_across_games_undecided(tmp_path):
    stage = make_pairs(tmp_path, {"Pong": [5, 6, 7], "Breakout": [1, 2, 3]})
    alone = {("ppo", "Qbert", seed): curve for (_, game, seed), curve in stage.compared.items() if game == "Pong"}
    stage.compared |= alone
    score = cells(claims.claims_table(stage))[2]
    assert score[1:4] == ["✓ 3 of 3", "✓ 3 of 3", "? 0 of 0"]
    assert score[4].startswith("? cannot be told apart with these runs: +")


def test_before_90_percent_of_the_schedule_it_is_too_early_for_a_final_score_and_for_all_that_quotes_it(tmp_path):
    differences = {"Pong": [5, 6, 7], "Breakout": [1, 2, 3]}
    finished, early = make_pairs(tmp_path / "a", differences), make_pairs(tmp_path / "b", differences, iterations=3)
    assert (finished.name, early.name) == ("finished", "beginnings")
    score, *others = cells(claims.claims_table(early))[2:]
    assert score[1:] == ["too early"] * 3
    assert others == cells(claims.claims_table(finished))[3:] and "too early" not in str(others)
    assert "interquartile" in figures.stage_tables(finished)["score"]
    assert "interquartile" not in figures.stage_tables(early)["score"]
    assert [row[-1] for row in cells(claims.short_table([early]))[2:]] == ["too early"] * 2
    assert [row[-1] for row in cells(claims.short_table([finished]))[2:]] == ["✓ 3 of 3 pairs"] * 2


def test_the_short_table_has_the_pairs_of_each_game_s_most_advanced_stage(tmp_path):
    whole = {"mean_return_100": [1, 2, 3], "kl": [0.1, 0.1, 0.4]}
    part = {"mean_return_100": [1, 7], "kl": [0.1, 0.1]}
    runs = {("ppo", "Pong", 1): whole, ("acppo", "Pong", 1): {**whole, "kl": [0.1, 0.1, 0.1]}}
    runs |= {("ppo", "Pong", 2): part, ("acppo", "Pong", 2): part, ("product", "Qbert", 1): part}
    runs |= {("ppo", "Breakout", 1): part, ("acppo", "Breakout", 1): part, ("ppo", "Breakout", 2): part}
    assert cells(claims.short_table(make_stages(tmp_path, runs)))[2:] == [
        ["Breakout", "1", "2,048", "7.0", "7.0", "1.00", "too early"],
        ["Pong", "1", "3,072", "3.0", "3.0", "2.00", "undecided: 0 of 1, 1 equal pairs"],
    ]


def test_a_clip_ratio_holds_inside_its_band_for_every_run(tmp_path):
    for ratio, judged in ((0.119, "✓ 3 of 3"), (0.121, "✗ 0 of 3"), (0.079, "✗ 0 of 3")):
        stage = make_pairs(tmp_path, {"Pong": [0, 0, 0]}, avg_clip_ratio=[ratio, ratio])
        assert cells(claims.claims_table(stage))[-1][1] == judged


# ---------------------------------------------------------------------------------------- any two variants compared
def make_trios(out, baseline: str, challenger: str) -> claims.Stage:
    """Returns three seeds of each of ppo, acppo and mine, compared as given."""
    columns = {
        "ppo": {"mean_return_100": [0, 10], "kl": [1, 5], "avg_clip_ratio": 0.1},
        "acppo": {"mean_return_100": [0, 9], "kl": [6, 6], "avg_clip_ratio": 0.11},
        "mine": {"mean_return_100": [0, 12], "kl": [1, 1], "avg_clip_ratio": 0.13},
    }
    runs = {(variant, "Pong", seed): columns[variant] for variant in columns for seed in (1, 2, 3)}
    (stage,) = make_stages(out, runs, baseline=baseline, challenger=challenger)
    return stage


@pytest.mark.parametrize(
    ("baseline", "challenger", "base", "new", "near", "signs"),
    [
        ("ppo", "acppo", "PPO", "AC-PPO", "0.1 (0.08 to 0.12)", "✗✗✗?✓"),
        ("ppo", "mine", "PPO", "mine", "0.1 (0.08 to 0.12)", "✓✓??✗"),
        ("mine", "ppo", "mine", "PPO", "mine's ε, 0.2 (0.18 to 0.22)", "✗✗✗?✗"),
    ],
)
def test_the_verdicts_are_on_the_variants_that_are_named(baseline, challenger, base, new, near, signs, tmp_path):
    stage = make_trios(tmp_path, baseline, challenger)
    rows = cells(claims.claims_table(stage))[2:]
    assert [row[0] for row in rows] == [
        f"{new}'s final score is above {base}'s",
        f"{new}'s KL between policy updates is smaller",
        f"{new} has fewer KL spikes above the 99th percentile of {base}'s",
        f"{new} has fewer KL spikes above ten times the run's own median",
        f"{new}'s average clip ratio is near {near}",
    ]
    assert "".join(row[1][0] for row in rows) == signs
    header, _, pong = cells(claims.short_table([stage]))
    assert header[3:] == [base, new, f"{base}'s KL ÷ {new}'s", f"{new} scores more"] and pong[-1][0] == signs[0]


def test_a_third_variant_stands_beside_the_two_that_all_texts_name(tmp_path):
    stage = make_trios(tmp_path, "mine", "ppo")
    text = figures.results_part([stage])
    for said in (
        "variants acppo, mine, ppo",
        "mine's above its own 99th percentile",
        "pairs of mine and ppo with the same seed (the clip ratio by runs of ppo)",
        "spikes: above mine's 99th percentile",
        "| ppo − mine, by pairs |",
        "| Pong | acppo | 3 |",
    ):
        assert said in text, said
    assert "Dashed: mine's ε = 0.2. Thin" in figures.captions(stage)["avg_clip_ratio"]
    figure = figures.draw_figure("avg_clip_ratio", stage)
    (dashed,) = (line for line in figure.axes[0].lines if line.get_linestyle() == "--")
    assert (dashed.get_ydata()[0], dashed.get_color()) == (0.2, figures.style(stage.drawn, "mine")["color"])
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ppo", "acppo", "mine"]


def test_a_challenger_s_clip_ratio_is_held_against_the_epsilon_of_the_baseline_s_runs(tmp_path):
    for baseline, ratio, judged in (("mine", 0.19, "✓"), ("mine", 0.1, "✗"), ("ppo", 0.1, "✓"), ("product", 0.1, "?")):
        runs = {
            (variant, "Pong", seed): {"avg_clip_ratio": [ratio]} for variant in (baseline, "own") for seed in (1, 2, 3)
        }
        (stage,) = make_stages(tmp_path, runs, baseline=baseline, challenger="own")
        assert cells(claims.claims_table(stage))[-1][1][0] == judged


@pytest.mark.parametrize("variant", ["product", "without"])  # c = inf; and a script that has no ε
def test_a_variant_without_an_epsilon_has_no_line_and_no_verdict_on_it(variant, tmp_path):
    runs = {(name, "Pong", 1): {"kl": [1, 2]} for name in (variant, "ppo")}
    (stage,) = make_stages(tmp_path, runs, baseline=variant, challenger="ppo")
    claim = cells(claims.claims_table(stage))[-1]
    assert claim[:2] == [f"PPO's average clip ratio is near {variant}'s ε, which no run has", "? 0 of 0"]
    assert "Dashed" not in figures.captions(stage)["avg_clip_ratio"]
    assert f"for {variant}" not in figures.captions(stage)["tv_distance"]
    assert not [
        line for line in figures.draw_figure("avg_clip_ratio", stage).axes[0].lines if line.get_linestyle() == "--"
    ]


def test_it_is_said_if_runs_of_one_variant_were_trained_by_several_texts_of_its_script(tmp_path):
    keys = [("ppo", "Pong", 1), ("ppo", "Pong", 2), ("mine", "Pong", 1), ("mine", "Pong", 2), ("own", "Pong", 1)]
    (stage,) = make_stages(tmp_path, {key: {"kl": [1]} for key in keys})
    hashes = dict(zip(keys, ("sha256 a1", "sha256 b2", "sha256 c3", "sha256 c3", "unknown; sha256 d4")))
    versions = [{"script": hashes[key]} for key in stage.runs[collect.KEY].itertuples(index=False, name=None)]
    stage.runs["versions"] = list(map(json.dumps, versions))
    assert "Trained by more than one text of the script: ppo. All in" in figures.coverage(stage)
    stage.runs["versions"] = "{}"  # of older commits
    assert "text of the script" not in figures.coverage(stage)


# ------------------------------------------------------------------------------------------ tables and figures
def test_the_score_table_gives_mean_and_sample_deviation_and_says_where_games_are_few(tmp_path):
    runs = {
        ("ppo", "BattleZone", 1): {"mean_return_100": [0, 10], "games_ended": [9, 120]},
        ("ppo", "BattleZone", 2): {"mean_return_100": [0, 20], "games_ended": [8, 99]},
        ("acppo", "BattleZone", 1): {"mean_return_100": [0, 12], "games_ended": [8, 100]},
        ("acppo", "CartPole-v1", 1): {"mean_return_100": [math.nan, math.nan], "games_ended": 0},
    }
    (stage,) = make_stages(tmp_path, runs)
    header, _, battle_zone, cartpole, *published = cells(claims.score_table(stage.compared))
    assert header == ["game", "agent steps", "ppo", "acppo", "random", "human"]
    assert battle_zone[:4] == ["BattleZone", "2,048", "15.0 ± 7.1 (n = 2, 99 games)", "12.0 (n = 1)"]
    assert battle_zone[4:] == ["2,360.0", "37,187.5"] and cartpole == ["CartPole-v1", "2,048", "–", "–", "–", "–"]
    # Trainings of other lengths than ours stand in a table of their own
    assert published[0] == ["game", "published", "agent steps", "score", "note"]
    assert {(row[0], row[2]) for row in published[2:]} == {("BattleZone", "10,000,000")}
    ppo2 = ["openai/baselines ppo2 (CleanRL docs/benchmark)", "10,000,000", "19,980.0 ± 1,355.2", "3 seeds"]
    assert ["BattleZone", *ppo2] in published


def test_the_human_normalised_table_says_where_seeds_are_too_few_for_an_interval(tmp_path):
    stage = make_pairs(tmp_path, {"Pong": [3.53]})  # a tenth of the human range
    table = cells(claims.human_table(stage))[2:]
    assert table[0] == ["ppo", "1", "1", f"{(10 + 20.7) / 35.3:.3f}", "no interval: one seed"]
    assert table[2] == ["acppo − ppo, by pairs", "1", "1", "0.100", "no interval: one seed"]


@pytest.mark.parametrize(("game", "frames"), [("BattleZone", 4), ("ALE/Pong-v5", 4), ("CartPole-v1", 1)])
def test_the_horizontal_axis_counts_frames_on_atari_alone(game, frames, tmp_path):
    axis = Figure().subplots()
    (stage,) = make_stages(tmp_path, {("ppo", game, 1): {"mean_return_100": [1, 2, 3]}})
    figures.draw_panel(axis, stage.drawn, game, "mean_return_100")
    assert list(axis.lines[-1].get_xdata()) == [frames * BATCH * i for i in (1, 2, 3)]
    assert list(axis.lines[-1].get_ydata()) == [1, 2, 3]


def test_mean_and_band_are_over_seeds_as_far_as_all_have_got(tmp_path):
    def draw(column: str, of_seeds: list) -> Figure:
        runs = {("ppo", "Pong", seed): {column: values} for seed, values in enumerate(of_seeds, start=1)}
        (stage,) = make_stages(tmp_path, runs, iterations=1000)
        axis = Figure().subplots()
        figures.draw_panel(axis, stage.drawn, "Pong", column)
        return axis

    axis = draw("mean_return_100", [[1, 2, 3], [3, 6]])
    np.testing.assert_equal(axis.lines[-1].get_ydata(), [2, 4, math.nan])
    band = axis.collections[0].get_paths()[0].vertices
    assert band[:, 1].min() == pytest.approx(2 - math.sqrt(2)) and band[:, 1].max() == pytest.approx(4 + math.sqrt(8))
    drawn = draw("kl", [range(1, 61), range(1, 41)]).lines[-1].get_ydata()
    assert np.isfinite(drawn[:40]).all() and np.isnan(drawn[40:]).all()


def test_a_figure_says_game_seeds_units_and_bounds(tmp_path):
    keys = [("ppo", "BattleZone", 1), ("ppo", "BattleZone", 2), ("acppo", "BattleZone", 1), ("ppo", "CartPole-v1", 1)]
    (stage,) = make_stages(tmp_path, {key: {"kl": [0.1, 0.2, 0.1]} for key in keys})
    drawn = {name: figures.draw_figure(name, stage) for name in figures.FIGURES}
    for name, figure in drawn.items():
        titles = [axis.get_title() for axis in figure.axes if axis.axison]
        assert set(titles) == {"BattleZone\n(n = 2 ppo, 1 acppo)", "CartPole-v1 (n = 1)"}
        assert {axis.get_xlabel() for axis in figure.axes[:2]} == {"emulator frames (4 a step)", "agent steps"}
        assert figure.axes[0].get_ylabel() == next(iter(figures.FIGURES[name][1].values()))
    # PPO's ε 0.1 in the clip ratio, ε / 2 of both variants in the TV distance
    level = {
        name: [float(line.get_ydata()[0]) for line in drawn[name].axes[0].lines if line.get_linestyle() == "--"]
        for name in drawn
    }
    assert level["avg_clip_ratio"] == [0.1] and sorted(level["tv_distance"]) == [0.05, 0.08]


def test_a_pair_has_one_seed_and_a_seed_without_a_partner_is_in_none(tmp_path):
    runs = {("ppo", "Pong", seed): {"mean_return_100": [score]} for seed, score in ((1, 10), (2, 20), (3, 30))}
    runs |= {("acppo", "Pong", seed): {"mean_return_100": [score]} for seed, score in ((2, 21), (3, 32), (4, 40))}
    (stage,) = make_stages(tmp_path, runs)
    assert list(claims.find_margins(stage)["score"]["Pong"]) == [1, 2]


# ------------------------------------------------------------------------------------------------- whole calls
@pytest.fixture
def two_figures(monkeypatch):
    """Has fewer figures drawn, which takes most of a call's time."""
    monkeypatch.setattr(figures, "FIGURES", {name: figures.FIGURES[name] for name in ("score", "kl")})


def test_a_call_makes_everything_the_same_again_and_touches_no_other_grid(tmp_path, monkeypatch, two_figures):
    """The default grid writes the README beside it, another grid neither that nor anything of the default grid."""
    monkeypatch.setattr(figures, "ROOT", tmp_path)
    monkeypatch.setattr(figures, "DEFAULT_OUT", default := tmp_path / "benchmark" / "results")
    default.mkdir(parents=True)
    marks = "before é\n<!-- results -->\nold\n<!-- end results -->\nafter\n"
    for path in (tmp_path / "README.md", default / "README.md"):
        path.write_text(marks, encoding="utf-8")
    scores = {"mean_return_100": [1, 2], "kl": [0.1, 0.2]}
    for variant in ("ppo", "acppo", "of my own"):
        make_run(default, variant, **scores)
        make_run(tmp_path / "other", variant, "Pong", **scores)
    call(monkeypatch, "--out", default)
    made, stages = contents(default), claims.make_stages(*collect.read_csvs(default))
    for name in figures.FIGURES:
        assert made[f"figures/beginnings/{name}.png"].startswith(b"\x89PNG")
        assert len(made[f"figures/beginnings/{name}.png"]) > 10_000
        assert b"</svg>" in made[f"figures/beginnings/{name}.svg"]
    assert made["README.md"].decode() == marks.replace("old\n", figures.results_part(stages))
    assert "](figures/beginnings/score.png)" in made["README.md"].decode()
    assert (tmp_path / "README.md").read_text(encoding="utf-8") == marks.replace("old\n", claims.short_table(stages))
    assert not list(tmp_path.rglob("*new*"))  # no file is left beside those replaced

    before = contents(default) | {"above": (tmp_path / "README.md").read_bytes()}
    call(monkeypatch, "--out", tmp_path / "other")
    assert contents(default) | {"above": (tmp_path / "README.md").read_bytes()} == before
    assert (tmp_path / "other" / "figures" / "beginnings" / "kl.svg").exists()
    assert "| of my own |" in (tmp_path / "other" / "README.md").read_text(encoding="utf-8")
    shutil.rmtree(default / "runs")  # the rest from the CSVs alone
    call(monkeypatch, "--out", default)
    after = contents(default) | {"above": (tmp_path / "README.md").read_bytes()}
    assert after == {name: data for name, data in before.items() if not name.startswith("runs/")}


@pytest.mark.parametrize(
    ("command", "largest", "file"),
    [(collect, 4000, "curves.csv"), (figures, 9000, "figures/finished/score.png")],
    ids=["collect", "figures"],
)
def test_on_a_full_disk_the_file_is_named_and_all_are_as_before(
    command, largest, file, tmp_path, monkeypatch, capfd, two_figures
):
    """No file can grow beyond `largest` bytes, as if the disk were full."""
    make_run(tmp_path, kl=range(1, 501), mean_return_100=range(500))
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    if command is figures:
        (tmp_path / file).write_bytes(b"as it was")
        collect.collect(tmp_path)
        monkeypatch.setattr(figures, "read_grid", collect.read_csvs)
    before, limits = contents(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest, limits[1]))
    try:
        with pytest.raises(SystemExit) as ended:
            call(monkeypatch, "--out", tmp_path, command=command)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = f"--out {tmp_path}: cannot use {tmp_path / file} (File too large)\n"
    assert (ended.value.code, capfd.readouterr().err) == (2, said)
    after = contents(tmp_path)
    assert {name: data for name, data in after.items() if name in before} == before
    assert set(after) - set(before) <= {"runs.csv", "README.md"}  # each of which is whole


def test_another_pair_s_verdicts_go_into_the_grid_s_readme_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(figures, "DEFAULT_OUT", tmp_path)  # beside a project whose README has no place for a table
    monkeypatch.setattr(figures, "ROOT", tmp_path / "nowhere")
    monkeypatch.setattr(figures, "draw", lambda *_: None)
    make_trios(tmp_path, "ppo", "acppo")
    call(monkeypatch, "--out", tmp_path, "--challenger", "mine")
    assert "| mine's final score is above PPO's | ✓ 3 of 3 |" in (tmp_path / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--challenger", "thine"], "--challenger thine: no run is of this variant; give one of acppo, mine, ppo"),
        (["--baseline", "thine"], "--baseline thine: no run is of this variant; give one of acppo, mine, ppo"),
        (["--baseline", "acppo"], "--challenger acppo: is the baseline, too"),
    ],
)
def test_a_pair_that_cannot_be_compared_is_refused_in_one_line(flags, said, tmp_path, monkeypatch, capfd):
    make_trios(tmp_path, "ppo", "acppo")
    with pytest.raises(SystemExit) as ended:
        call(monkeypatch, "--out", tmp_path, *flags)
    out, err = capfd.readouterr()
    assert (ended.value.code, out, err.count("\n")) == (2, "", 1) and said in err
    assert not (tmp_path / "figures").exists()


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--out", "nowhere"], "has neither runs nor their CSVs"),
        (["--out", "empty"], "no run there has an iteration"),
        (["--out", "foreign"], "has other columns"),
        (["--out", "damaged"], "cannot be read"),
        (["--out", "o\udcff"], "--out {}/o\ufffd: give it in UTF-8"),  # a byte that is no UTF-8, as Python decodes it
    ],
)
def test_bad_input_is_refused_in_one_line(flags, said, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty" / "runs").mkdir(parents=True)
    for name, text in (("foreign", "a,b\n1,2\n"), ("damaged", ",".join(collect.RUN_COLUMNS) + "\nx,y,no number\n")):
        (tmp_path / name).mkdir()
        for file in ("runs.csv", "curves.csv"):
            (tmp_path / name / file).write_text(text)
    for command in (collect, figures):
        with pytest.raises(SystemExit) as exit_:
            call(monkeypatch, *flags, command=command)
        out, err = capfd.readouterr()
        assert exit_.value.code == 2 and out == "" and err.count("\n") == 1 and said.format(tmp_path) in err


def test_a_directory_below_one_whose_name_is_no_utf_8_is_refused(tmp_path, monkeypatch, capfd):
    (tmp_path / "o\udcff").mkdir()
    monkeypatch.chdir(tmp_path / "o\udcff")
    with pytest.raises(SystemExit) as exit_:
        call(monkeypatch, "--out", "grid", command=collect)
    assert (exit_.value.code, capfd.readouterr().err) == (2, f"--out {tmp_path}/o\ufffd/grid: give it in UTF-8\n")


def test_a_readme_that_has_lost_its_marks_is_said_and_left(tmp_path, monkeypatch, capfd):
    make_csvs(tmp_path, {("ppo", "Pong", 1): {"kl": [1]}})
    for text in ("<!-- end results -->\n<!-- results -->\n", "<!-- results -->\n<!-- end results -->\n" * 2):
        (tmp_path / "README.md").write_text(text)
        with pytest.raises(SystemExit) as exit_:
            call(monkeypatch, "--out", tmp_path)
        assert exit_.value.code == 2 and "to write between" in capfd.readouterr().err
        assert (tmp_path / "README.md").read_text() == text


def test_the_results_in_the_repository_are_those_of_its_csvs():
    stages = claims.make_stages(*collect.read_csvs(collect.DEFAULT_OUT))
    for path, part in (
        (collect.DEFAULT_OUT / "README.md", figures.results_part(stages)),
        (ROOT / "README.md", claims.short_table(stages)),
    ):
        assert readme.split_readme(path, "results")[1] == part, "run benchmark/figures.py"


def test_neither_the_verdicts_nor_the_grid_import_what_they_do_not_use():
    """The verdicts go without matplotlib; torch would be imported into every worker of Ray."""
    program = "import sys, benchmark.claims, benchmark.atari5; print(*{'matplotlib', 'torch'} & set(sys.modules))"
    run = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert run.stdout == "\n"
