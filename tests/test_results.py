"""The results: training directories, run directories, the rule, tables, figures, and what a call may touch."""

import gzip
import itertools
import json
import math
import re
import shutil
from pathlib import Path
from unittest import mock

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from benchmark import claims, collect, figures, report
from conftest import ROOT, cells

BATCH = 1024  # agent steps of an iteration
VERSIONS = {"python": "3.12", "torch": "2.13.0"}
EPSILONS = {"acppo": {"clip_coef": 0.16, "c": 1.0}, "mine": {"clip_coef": 0.2}, "product": {"clip_coef": 1, "c": "inf"}}
RECORD = dict.fromkeys(("evaluation", "hours")) | {"steps": 1024, "arguments": {}, "commit": "", "machine": "2 cores"}


def make_arguments(variant: str, game: str, seed: int) -> dict:
    arguments = {"exp_name": variant, "env_id": game, "seed": seed, "total_timesteps": 10 * BATCH}
    return arguments | EPSILONS.get(variant, {"clip_coef": 0.1})


def make_training(out, variant="ppo", game="CartPole-v1", seed=1, started=1, **columns):
    """Makes a training directory as a script does: `columns` are logged, a value an iteration."""
    directory = out / "training" / f"{game}__{variant}__{seed}__{started}"
    directory.mkdir(parents=True)
    log(directory, {collect.TAGS[column]: dict(enumerate(values, start=1)) for column, values in columns.items()})
    provenance = {"commit": "abc", "machine": "a machine", "threads": 1, **VERSIONS}
    arguments = {**make_arguments(variant, game, seed), "log_dir": "a b"}
    record = {"command": "ppo_atari.py '--log-dir=a b'", "args": arguments, "provenance": provenance}
    (directory / "args.json").write_text(json.dumps(record))
    return directory


def log(directory, points: dict[str, dict[int, float]], start: int = 1, provenance: str = "") -> None:
    """Writes an event file as a start of a run does: tag → iteration → value; an iteration takes an hour."""
    clock = "tensorboard.summary.writer.event_file_writer.time.time"  # names the file, and dates its first event
    with mock.patch(clock, return_value=start * 1e6):
        writer = SummaryWriter(str(directory))
        for tag, values in points.items():
            for iteration, value in values.items():
                writer.add_scalar(tag, value, iteration * BATCH, walltime=start * 1e6 + 3600 * iteration)
        if provenance:
            writer.add_text("provenance", provenance)
        writer.close()


def make_stages(runs: dict[tuple, dict], iterations: int | None = None, **pair) -> list[claims.Stage]:
    """Returns the stages of (variant, game, seed) → column → a value an iteration; columns not given are 0.1, and a
    schedule that is not given is as long as the longest."""
    curves = {}
    for key, columns in runs.items():
        curve = pd.DataFrame({**dict.fromkeys(collect.TAGS, 0.1), "games_ended": 100, **columns})
        curves[key] = curve.set_index(BATCH * np.arange(1, len(curve) + 1))
    about = RECORD | {"total_timesteps": (iterations or max(map(len, curves.values()))) * BATCH, "versions": {}}
    records = {key: about | {"arguments": make_arguments(*key)} for key in runs}
    return claims.make_stages(records, curves, **pair)


def make_pairs(differences: dict[str, list[float]], iterations: int = 2) -> claims.Stage:
    """Returns the one stage of a pair for each final difference of scores, by game."""
    each = [(game, *numbered) for game, of_game in differences.items() for numbered in enumerate(of_game)]
    runs = {("ppo", game, seed): {"mean_return_100": [0, 10]} for game, seed, _ in each}
    runs |= {("acppo", game, seed): {"mean_return_100": [0, 10 + difference]} for game, seed, difference in each}
    return make_stages(runs, iterations)[0]


def contents(directory) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def refusal(call_main, command, *flags) -> str:
    """Returns the one line in which a call refuses its input, and checks that it changed nothing."""
    before = contents(Path.cwd())
    ended = call_main(command, *map(str, flags))
    assert (ended.status, ended.out, ended.err.count("\n")) == (2, "", 1) and contents(Path.cwd()) == before
    return ended.err


def test_all_points_are_read_and_a_step_logged_twice_keeps_the_last(tmp_path):
    """By itself, TensorBoard's reader keeps 10,000 points of a tag."""
    directory = make_training(tmp_path, kl=range(10_001))
    log(directory, {"losses/kl": {10_001: 7, 10_002: 8}, "losses/grad_norm": {10_002: 0.5}}, start=100)
    record, curve = collect.read_training(directory)
    assert list(curve.kl) == [*range(10_000), 7, 8] and list(curve.index) == [BATCH * i for i in range(1, 10_003)]
    assert curve.grad_norm.dropna().to_dict() == {record["steps"]: 0.5}
    assert record["hours"] == 10_001 + 10_002  # without the pause


def test_games_count_from_where_they_end_and_starts_where_they_differ(tmp_path):
    directory = make_training(tmp_path, kl=[1, 2, 3])
    log(directory, {"charts/episodic_return": {0.1: 0, 1: 0, 1.1: 0, 1.2: 0, 2.9: 0}}, start=2)
    for start, (commit, machine) in enumerate((("abc", "one"), ("def", "one"), ("abc", "other")), start=3):
        log(directory, {}, start, provenance=f"|name|value|\n|-|-|\n|commit|{commit}|\n|machine|{machine}|")
    record, curve = collect.read_training(directory)
    assert list(curve.games_ended) == [2, 4, 5]
    assert (record["commit"], record["machine"], record["threads"]) == ("abc; def", "one; other; a machine", "1")


def test_a_run_is_its_record_and_a_curve_of_six_digits(tmp_path):
    directory = make_training(tmp_path, "acppo", seed=7, kl=[1 / 3, 1e-5 / 3], mean_return_100=[9, 10])
    games = [(1, 10), (2, 20), (1, 11), (2, 20), (3, 60)]  # of two evaluations; the last one counts
    (directory / "eval.csv").write_text("step,game,score,length\n" + "".join(f"2048,{n},{s},99\n" for n, s in games))
    (path,) = collect.collect(tmp_path)
    record = json.loads((path / "run.json").read_text())
    assert (path, record["source"]) == (tmp_path / "runs" / "CartPole-v1__acppo__7", "CartPole-v1__acppo__7__1")
    known = {"variant": "acppo", "game": "CartPole-v1", "seed": 7, "note": "", "steps": 2048, "versions": VERSIONS}
    known |= {"commit": "abc", "machine": "a machine", "command": "ppo_atari.py"}
    known |= {"evaluation": {"games": 3, "mean": 30.3333, "std": 26.0832}}
    assert record | known | {"arguments": make_arguments("acppo", "CartPole-v1", 7)} == record
    rows = pd.read_csv(path / "curve.csv.gz", dtype=str)
    assert list(rows.columns) == ["step", *collect.TAGS, "games_ended"]
    assert list(rows.kl) == ["0.333333", "3.33333e-06"] and list(rows.mean_return_100) == ["9", "10"]
    assert (path / "curve.csv.gz").read_bytes()[4:8] == bytes(4)  # gzip's time of writing
    (path / "curve.csv.gz").write_bytes(gzip.compress(b"step,kl,games_ended\n1024,0.5,3\n"))
    (curve,) = collect.read_runs(tmp_path)[1].values()  # of an older run, which lacks what is newer
    assert list(curve.columns) == [*collect.TAGS, "games_ended"] and curve.kl[1024] == 0.5


def test_an_evaluation_is_the_last_step_of_all_seeds_and_a_game_has_ale_pys_name(tmp_path):
    directory = make_training(tmp_path, game="pong", kl=[1])
    games = ["512,1,3,7", "1024,1,1,10", "1024,2,1,20", "1024,1,1,12", "1024,1,2,31"]  # the second is replaced
    (directory / "eval.csv").write_text("step,seed,game,score,length\n" + "".join(f"{game},99\n" for game in games))
    record, _ = collect.read_training(directory)
    assert record["evaluation"] == {"games": 3, "mean": 21, "std": 9.53939} and record["game"] == "Pong"


def test_a_new_run_adds_files_and_an_older_one_is_updated(tmp_path):
    first = make_training(tmp_path, seed=1, kl=[1, 2])
    collect.collect(tmp_path)
    before = contents(tmp_path / "runs")
    collect.collect(tmp_path, [make_training(tmp_path, "two words", seed=2, kl=[3])], note="later")
    after = contents(tmp_path / "runs")
    assert before.items() <= after.items()
    assert {name.split("/")[0] for name in after.keys() - before.keys()} == {"CartPole-v1__two-words__2__later"}
    log(first, {"losses/kl": {3: 3}}, start=2)
    collect.collect(tmp_path)  # the second one stays where it is
    changed = {name for name, data in contents(tmp_path / "runs").items() if data != after.get(name)}
    assert changed == {"CartPole-v1__ppo__1/run.json", "CartPole-v1__ppo__1/curve.csv.gz"}


def test_another_run_with_the_same_key_needs_a_note(tmp_path, call_main):
    collect.collect(tmp_path, [make_training(tmp_path, started=1, kl=[1])])
    other = make_training(tmp_path, started=2, kl=[2])
    third, fourth = (make_training(tmp_path, seed=3, started=started, kl=[3]) for started in (1, 2))
    for directories, refused in (([third, other], other), ([third, fourth], fourth), ([], other)):  # []: OUT/training
        line = refusal(call_main, collect, "--out", ".", *directories)
        assert "give --note" in line and refused.name in line
    collect.collect(tmp_path, [other], note="again")
    assert [[*c.kl] for note in ("", "again") for c in collect.read_runs(tmp_path, note)[1].values()] == [[1], [2]]


def test_a_directory_that_is_no_run_is_left_out(tmp_path, capfd):
    (make_training(tmp_path, seed=2, kl=[1]) / "args.json").write_text("{")
    (make_training(tmp_path, seed=3, kl=[1]) / "args.json").unlink()
    make_training(tmp_path, seed=4)  # no iteration
    make_training(tmp_path, kl=[1])
    assert len(collect.collect(tmp_path)) == 1 and capfd.readouterr().err.count("left out") == 3


def test_interquartile_mean_weighs_borders_by_their_part_inside():
    for values, mean in (([5], 5), ([1, 2], 1.5), ([100, 0, 1, 2], 1.5), ([0, 1, 2, 5, 100], (0.75 + 2 + 3.75) / 2.5)):
        assert claims.interquartile_mean(np.array(values, dtype=float)) == pytest.approx(mean)


def test_signed_rank_p_is_the_share_of_all_assignments_of_signs():
    by_hand = {(5.0, -1, 2, 2, -9): (4, 1, 2.5, 2.5, 5), (0.0, 0, -3, 7, 7, 7, 9): (1.5, 1.5, 3, 5, 5, 5, 7)}
    for margins, ranks in by_hand.items():
        ways = itertools.product((-1, 1), repeat=len(ranks))
        totals = [abs(sum(sign * rank for sign, rank, size in zip(way, ranks, margins) if size)) for way in ways]
        observed = abs(sum(rank * np.sign(size) for rank, size in zip(ranks, margins)))
        assert claims.signed_rank_test(np.array(margins))[1] == np.mean(np.array(totals) >= observed)


@pytest.mark.parametrize(("sizes", "errors"), [(range(1, 6), 0), (range(1, 7), 2), (range(1, 10), 20), ([1] * 9, 20)])
def test_equal_algorithms_are_told_apart_at_most_one_time_in_twenty(sizes, errors):
    judged = [claims.judge(np.array(sizes) * signs) for signs in itertools.product((-1, 1), repeat=len(sizes))]
    assert judged.count("holds") == judged.count("does not hold") == errors / 2 <= len(judged) / 40
    assert judged.count("too few pairs") == (len(judged) if len(sizes) < 6 else 0)


def test_a_shift_of_one_deviation_is_found_with_15_pairs():
    judged = [claims.judge(margins) for margins in np.random.default_rng(1).normal(1, 1, (500, 15))]
    assert judged.count("holds") > 450


def test_the_fewest_pairs_that_change_a_verdict_are_as_counted_by_hand():
    known = {(): "6 or more further pairs, all for it or all against it"}
    known |= {(-1, -2): "4 or more further pairs, all against it"}
    # Of 17 pairs the lesser ranks may sum to 34, of 18 to 40 (tables of the test): 16 + 17 is below, 16 + 17 + 18 above
    known |= {(*range(1, 16),): "3 or more further pairs, all against it"}
    for margins, change in known.items():
        assert claims.find_change(np.array(margins)) == change


def test_atari5_scores_are_the_published_ones_and_wait_for_all_five_games():
    scores = claims.SCORES.pivot(index="game", columns="source", values="score_mean").filter(regex="ppo2|envpool")
    rainbow = pd.Series((62010, -0.3, 13136, 108528.6, 33817.5), claims.ATARI_5.index)  # arXiv 1710.02298, no-op starts
    all_scores = claims.ATARI_5[["random", "human"]].join(scores).assign(rainbow=rainbow, low=claims.ATARI_5.random - 9)
    assert all_scores.apply(claims.atari5_score).to_list() == pytest.approx([0, 85.05, 76.57, 68.11, 225.1, 0], 1e-4)
    runs = {("ppo", game, 2): {"mean_return_100": [human]} for game, human in claims.ATARI_5.human.items()}
    runs |= dict.fromkeys([("acppo", "Qbert", 1), ("acppo", "Pong", 1)], {"kl": [1]})
    rows = cells(report.atari5_table(make_stages(runs)[0].compared))[2:]
    assert sorted(rows) == [["acppo", "1", "needs BattleZone, DoubleDunk, NameThisGame, Phoenix"], ["ppo", "2", "85.1"]]


def test_the_table_of_runs_says_what_is_known_of_each():
    known = {"hours": 2.04, "evaluation": {"games": 30, "mean": 8.5, "std": 0.5}, "arguments": {"bf16": True}}
    known |= {"machine": "A, 2 cores, AVX2; B, 2 cores, AVX2; C, 4 cores", "commit": f"{'a' * 40}; {'b' * 40}-dirty"}
    records = {("ppo", "Pong", 1): RECORD | known, ("ppo", "Pong", 2): RECORD}
    curve = pd.DataFrame({"mean_return_100": [1, 12345.6], "kl": [0.1, 0.3]})
    text = report.run_table(records, dict.fromkeys(records, curve))
    rows = [row[5:] for row in cells(text)[2:]]
    assert "12,345.6" in text and "of 1 of 2, together 2.0" in text and rows[1] == ["–", "0.2", "2 cores", "–", ""]
    assert rows[0] == ["8.50 ± 0.50 (n = 30)", "0.2", "2 cores, AVX2; 4 cores, bf16", "2.0", "aaaaaaa; bbbbbbb-dirty"]


def test_scores_far_below_1_keep_three_digits():
    numbers = {0: "0.0", 0.0123: "0.0123", -0.95: "-0.950", 12.34: "12.3", 12345.6: "12,345.6", math.nan: "–"}
    assert {number: report.score(number) for number in numbers} == numbers
    assert report.score(0.0123, 0.0004) == "0.0123 ± 0.0004" and report.score(0, 0.5) == "0.000 ± 0.500"


def test_a_kl_of_0_or_below_by_rounding_gives_no_verdict_and_can_be_drawn(tmp_path):
    base = {("ppo", "Pong", seed): {"kl": [0, -6e-9, 2e-9, 1e-9]} for seed in (1, 2, 3)}
    for kl, judged in (([-6e-9, 1e-9, -1e-9, 0], "? 0 of 3, 3 equal"), ([0.1] * 4, "✗ 0 of 3")):
        (stage,) = make_stages(base | {("acppo", "Pong", seed): {"kl": kl} for seed in (1, 2, 3)})
        rows = cells(report.claims_tables(stage, "acppo")[1])[2:]
        assert [row[1] for row in rows[1:4]] == [judged, judged, "? 0 of 3, 3 equal"]
        figures.draw(stage, tmp_path)


def test_a_pair_has_game_and_seed_in_common():
    final = {("ppo", "Pong", 1): 1, ("ppo", "Pong", 2): 2, ("acppo", "Pong", 2): 5, ("acppo", "Pong", 3): 9}
    (stage,) = make_stages({key: {"mean_return_100": [score]} for key, score in final.items()})
    assert list(claims.find_margins(stage, "acppo")["score"]["Pong"]) == [3]


def test_stages_compare_each_game_at_one_step():
    pong = {("ppo", "Pong", 1): 100, ("acppo", "Pong", 1): 90, ("ppo", "Pong", 2): 88, ("acppo", "Pong", 2): 44}
    lengths = {("ppo", "Qbert", 1): 3, **pong, ("ppo", "Pong", 3): 43}
    finished, unfinished = make_stages({key: {"kl": range(1, length + 1)} for key, length in lengths.items()})
    assert (finished.name, unfinished.name) == ("finished", "unfinished")
    assert list(finished.drawn) == [("ppo", "Pong", 1), ("acppo", "Pong", 1)]
    assert [list(curve.kl) for curve in finished.compared.values()] == [list(range(1, 91))] * 2
    # The figures show them as far as the longest unfinished one, a finished one's first steps too
    drawn, compared = ({key: len(curve) for key, curve in c.items()} for c in (unfinished.drawn, unfinished.compared))
    assert drawn == {**lengths, ("ppo", "Pong", 1): 88, ("acppo", "Pong", 1): 88}
    assert compared == {**dict.fromkeys(pong, 44), ("ppo", "Qbert", 1): 3}
    assert "being shorter than half of their game's longest: Pong ppo 3." in report.coverage(unfinished)
    assert "2 runs, at 90 % to 100 % of a schedule of 102,400 agent steps." in report.coverage(finished)
    unfinished.runs["ppo", "Pong", 3]["versions"] = {"script": "another"}
    assert "Some runs of a variant were trained by different versions" in report.coverage(unfinished)


def test_spike_rates_are_as_counted_by_hand():
    ppo, acppo = [1] * 93 + [9] * 2 + [20] * 5, [1] * 97 + [30] * 3  # 99th percentile of the first 20, medians 1
    (stage,) = make_stages({("ppo", "Pong", 1): {"kl": ppo}, ("acppo", "Pong", 1): {"kl": acppo}})
    margins = {"score": 0, "KL": math.log(2.11 / 1.87), "relative spikes": 0 - 0.03, "own spikes": 0.05 - 0.03}
    found = {claim: of["Pong"].item() for claim, of in claims.find_margins(stage, "acppo").items()}
    assert found == pytest.approx({**margins, "clip ratio": 0.02})
    assert "| PPO's mean KL is 1.13 times AC-PPO's |" in report.claims_tables(stage, "acppo")[0]
    ppo_row, acppo_row = cells(report.kl_table(stage))[2:]
    # The TV distance is 0.1: above PPO's 0.1 / 2, above AC-PPO's 0.16 / 2
    assert ppo_row == ["Pong", "ppo", "1", "102,400", "2.11", "1", "20", "20", "0.00%", "5.00%", "100.00%", "0.1000"]
    assert acppo_row[4:] == ["1.87", "1", "30", "30", "3.00%", "3.00%", "100.00%", "0.1000"]
    seeds = {("ppo", "Pong", 1): {"kl": [1] * 100}, ("ppo", "Pong", 2): {"kl": [1] * 90 + [9] * 10}}
    assert claims.spike_limit(make_stages(seeds)[0], "Pong") == 9  # of all seeds


def test_a_claim_holds_on_a_game_where_three_pairs_all_agree():
    differences = ([1, 2, 3], [-1, -2, -3], [1, 2, -3], [1, 2, 0], [1, 2], [math.nan, 1, 1, 1])
    tables = [cells(report.claims_tables(make_pairs({"Pong": each}), "acppo")[1]) for each in differences]
    judged = ["✓ 3 of 3", "✗ 0 of 3", "? 2 of 3", "? 2 of 3, 1 equal", "too few pairs (2 of 2)", "✓ 3 of 3"]
    assert [table[2] for table in tables] == [["AC-PPO's final score is above PPO's", cell] for cell in judged]


def test_a_claim_is_judged_over_all_games_by_their_pairs_in_human_ranges():
    stage = make_pairs({"Pong": [5, 6, 7], "Breakout": [-1, 2, 3, 4], "CartPole-v1": [9, 9, 9]})
    margins = np.array([5, 6, 7]) / 35.3, np.array([-1, 2, 3, 4]) / 28.8  # CartPole has no human score
    mean = f"{claims.interquartile_mean(np.concatenate(margins)):+.3g} of human minus random score"
    # Of the 128 assignments of signs, two are more extreme than a single minus at the smallest, and two are as extreme
    row = ["✓ holds", mean, "6 of 7, p = 0.031", "1 or more further pairs, all against it"]
    assert cells(report.claims_tables(stage, "acppo")[0])[2][1:] == row
    two = cells(report.claims_tables(make_pairs({"Pong": [-1000, -3000]}), "acppo")[0])[2][1:]
    assert two == ["? too few pairs", "-2,000.0 points", "0 of 2, p = 0.5", "4 or more further pairs, all against it"]


def test_a_final_score_waits_for_90_percent_of_the_schedule():
    stages = [make_pairs({"Pong": [5, 6, 7], "Breakout": [1, 2, 3]}, iterations) for iterations in (2, 3)]
    for tables in zip(*(report.claims_tables(stage, "acppo") for stage in stages)):
        (score, *others), (early, *early_others) = (cells(table)[2:] for table in tables)
        assert score[1][0] == "✓" and early[1] == "too early" and others == early_others
    shorts = [cells(report.short_table(shown))[2:] for shown in (stages, stages[1:])]  # the first stage that has a game
    assert [row[-1] for rows in shorts for row in rows] == ["✓ 3 of 3"] * 2 + ["too early"] * 2


@pytest.mark.parametrize(
    ("baseline", "challenger", "title", "signs"),
    [
        ("ppo", "acppo", "Claims of the thesis", "✗✗✗?✓"),
        ("ppo", "mine", "mine against PPO", "✓✓??✗"),
        ("mine", "ppo", "PPO against mine", "✗✗✗?✗"),
        ("acppo", "acppo", "AC-PPO against AC-PPO", "????✓"),
        ("product", "ppo", "PPO against product", "✗✗✗?✗"),  # c = inf
        ("ppo", "spo", "spo against PPO", "✓✓??"),  # of ranges that do not clip
    ],
)
def test_verdicts_are_on_the_variants_that_are_named(baseline, challenger, title, signs):
    columns = {"ppo": ([0, 10], [1, 5], 0.1), "acppo": ([0, 9], [6, 6], 0.119)}
    columns |= dict.fromkeys(("mine", "product", "spo"), ([0, 12], [1, 1], 0.13))
    columns = {name: dict(zip(("mean_return_100", "kl", "avg_clip_ratio"), of)) for name, of in columns.items()}
    runs = {(variant, "Pong", seed): columns[variant] for variant in columns for seed in (1, 2, 3)}
    (stage,) = make_stages(runs, baseline=baseline, unclipped=("spo",))
    page = report.page_parts([stage], (challenger, "mine"))
    base, new = (report.DISPLAY_NAMES.get(name, name) for name in (baseline, challenger))
    assert page["verdicts"].startswith(f"{title}, finished runs:") and f"mine against {base}, fin" in page["verdicts"]
    rows = cells(page["results"].partition(f"{title}, by games:")[2].partition(" against ")[0])[2:]
    assert rows[0][0] == f"{new}'s final score is above {base}'s" and "".join(row[1][0] for row in rows[:5]) == signs
    assert cells(report.kl_table(stage))[-1][-2:] == ["–", "–"]  # spo has no ε / 2 and no clip ratio


def test_the_score_table_says_where_games_are_few():
    ends = {("ppo", "BattleZone", 1): (10, 120), ("ppo", "BattleZone", 2): (20, 99)}
    ends |= {("acppo", "BattleZone", 1): (12, 100), ("acppo", "CartPole-v1", 1): (math.nan, 0)}
    columns = {key: {"mean_return_100": [0, score], "games_ended": [0, count]} for key, (score, count) in ends.items()}
    (stage,) = make_stages(columns)
    battle_zone, cartpole = cells(report.score_table(stage.compared))[2:]
    assert battle_zone[:4] == ["BattleZone", "2,048", "15.0 ± 7.1 (n = 2, 99 games)", "12.0 (n = 1)"]
    assert battle_zone[4:] == ["2,360.0", "37,187.5"] and cartpole == ["CartPole-v1", "2,048", "–", "–", "–", "–"]


@pytest.mark.parametrize(("schedule", "ended"), [(20, 10), (38, 5), (40, 5), (42, 0)])
def test_progress_is_told_in_tenths_once_all_have_done_half(schedule, ended):
    (stage,) = make_stages({("ppo", "Pong", 1): {"mean_return_100": range(20), "kl": [1, 3] * 10}}, iterations=schedule)
    score, kl = cells(report.progress_table(stage))[2:] or ((), ())
    assert list(kl).count("–") == (10 - ended if ended else 0)  # those tenths have not ended
    assert list(map(float, score[2 : 2 + ended])) == [schedule * i // 10 - 1 for i in range(1, ended + 1)]
    assert schedule % 20 or list(kl[2 : 2 + ended]) == ["2"] * ended


def test_mean_and_band_end_where_the_shortest_run_does():
    for column in ("mean_return_100", "kl"):
        runs = {("ppo", "Pong", 1): {column: [1, 2, 3]}, ("ppo", "Pong", 2): {column: [3, 6]}}
        (stage,) = make_stages(runs, iterations=1000)
        figures.draw_panel(axis := Figure().subplots(), stage.drawn, "Pong", column, frames=4)
        np.testing.assert_equal(axis.lines[-1].get_ydata(), [2, 4, math.nan])
        assert list(axis.lines[-1].get_xdata()) == [4 * BATCH * i for i in (1, 2, 3)]
        if column == "mean_return_100":
            band = axis.collections[0].get_paths()[0].vertices[:, 1]
            assert (band.min(), band.max()) == pytest.approx((2 - math.sqrt(2), 4 + math.sqrt(8)))


def test_a_figure_says_games_seeds_units_and_keeps_its_colours(tmp_path):
    keys = [("ppo", "BattleZone", 1), ("ppo", "BattleZone", 2), ("acppo", "BattleZone", 1), ("mine", "CartPole-v1", 1)]
    (stage,) = make_stages({key: {"kl": [0.1, 0.2, 0.1]} for key in keys})
    figures.draw(stage, tmp_path)
    for name in figures.FIGURES:
        figure = figures.draw_figure(name, stage)
        assert {axis.get_title() for axis in figure.axes} == {"BattleZone\nn = 2, 1, 0", "CartPole-v1\nn = 0, 0, 1"}
        assert {axis.get_xlabel() for axis in figure.axes} == {"emulator frames", "agent steps"}
        assert [text.get_text() for text in figure.legends[0].get_texts()] == ["ppo", "acppo", "mine"]
        colours = [colour for _, colour in Image.open(tmp_path / f"{name}.png").convert("RGB").getcolors()]
        for variant in ("ppo", "acppo", "mine"):
            wanted = bytes.fromhex(figures.colour(stage.drawn, variant)[1:])
            assert min(max(abs(a - b) for a, b in zip(wanted, colour)) for colour in colours) < 20


def test_equal_runs_make_equal_files_and_touch_no_other_set(tmp_path, call_main):
    for started, flags in ((1, []), (2, ["--note", "spo", "--challenger", "mine"])):
        before = contents(tmp_path)
        columns = {"started": started, "mean_return_100": [1, 2], "kl": [0.1, 0.2]}
        named = [str(make_training(tmp_path, variant, **columns)) for variant in ("ppo", "mine")]
        call_main(report, *named, "--out", ".", *flags)
        made = contents(tmp_path)
        assert before.items() <= made.items()
        call_main(report, "--out", ".", *flags)
        assert contents(tmp_path) == made
    assert made.keys() > {f"figures/{of}unfinished/{name}.png" for name in figures.FIGURES for of in ("", "spo-")}
    assert all("| CartPole-v1 | mine |" in made[page].decode() for page in ("README.md", "spo.md"))
    make_training(tmp_path, seed=2, kl=[1])  # new, and not named
    call_main(report, "--out", ".", *flags)
    assert ("ppo", "CartPole-v1", 2) in collect.read_runs(tmp_path)[0]


def test_bad_input_is_refused_in_one_line(tmp_path, call_main):
    collect.collect(tmp_path, [make_training(tmp_path / "elsewhere", kl=[1], mean_return_100=[1])])
    (tmp_path / "README.md").write_text("<!-- end verdicts -->\n<!-- verdicts -->\n")  # nothing in between
    assert "letters" in refusal(call_main, collect, "--out", ".", "--note", "a/b")
    flags = {"--note none": "the note none", "--challenger x": "one of ppo", "": "between"}
    for given, words in flags.items():
        assert words in refusal(call_main, report, "--out", ".", *given.split())


def test_the_committed_pages_are_what_report_makes_of_the_runs(tmp_path, monkeypatch, call_main):
    out, pages = tmp_path / "results", [ROOT / "README.md", *collect.DEFAULT_OUT.glob("*.md")]
    shutil.copytree(collect.DEFAULT_OUT / "runs", out / "runs")
    for page in pages:
        text = re.sub(r"(<!-- (\w+) -->\n).*?(?=<!-- end \2)", r"\1", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        (tmp_path / page.relative_to(ROOT)).write_text(text, encoding="utf-8")
    monkeypatch.setattr(report, "ROOT", tmp_path)
    monkeypatch.setattr(report, "DEFAULT_OUT", out)
    monkeypatch.setattr(report, "draw", lambda stage, directory: None)
    for flags in ("", "--note 83-percent", "--note spo --challenger acppo spo"):
        assert call_main(report, "--out", "results", *flags.split()).status == 0
    for page in pages:
        assert (tmp_path / page.relative_to(ROOT)).read_bytes() == page.read_bytes(), "run benchmark/report.py"
    linked = [name for page in pages[1:] for name in re.findall(r"\((figures/.*?)\)", page.read_text(encoding="utf-8"))]
    committed = (collect.DEFAULT_OUT / "figures").rglob("*.*")
    assert sorted(linked) == sorted(path.relative_to(collect.DEFAULT_OUT).as_posix() for path in committed)
