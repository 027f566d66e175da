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
from conftest import ROOT

BATCH = 1024  # agent steps of an iteration
VERSIONS = {"python": "3.12", "torch": "2.13.0"}
EPSILONS = {"acppo": {"clip_coef": 0.16, "c": 1.0}, "mine": {"clip_coef": 0.2}, "without": {}}
EPSILONS["product"] = {"clip_coef": 0.1, "c": "inf"}


def make_arguments(variant: str, game: str, seed: int) -> dict:
    arguments = {"exp_name": variant, "env_id": game, "seed": seed, "total_timesteps": 10 * BATCH, "threads": 2}
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
    about = {
        "total_timesteps": (iterations or max(map(len, curves.values()))) * BATCH,
        "evaluation": None,
        "hours": None,
    }
    records = {key: {**about, "versions": {}, "arguments": make_arguments(*key)} for key in runs}
    return claims.make_stages(records, curves, **pair)


def make_pairs(differences: dict[str, list[float]], iterations: int = 2) -> claims.Stage:
    """Returns the one stage of a pair for each final difference of scores, by game."""
    each = [(game, *numbered) for game, of_game in differences.items() for numbered in enumerate(of_game)]
    runs = {("ppo", game, seed): {"mean_return_100": [0, 10]} for game, seed, _ in each}
    runs |= {("acppo", game, seed): {"mean_return_100": [0, 10 + difference]} for game, seed, difference in each}
    return make_stages(runs, iterations)[0]


def contents(directory) -> dict[str, bytes]:
    return {str(path.relative_to(directory)): path.read_bytes() for path in directory.rglob("*") if path.is_file()}


def cells(markdown: str) -> list[list[str]]:
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


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
    assert record["hours"] == {"wall": 10_001 + 10_002, "core": 2 * 20_003}  # no pause; two threads


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
    games = [(1, 10), (2, 20), (1, 10), (2, 20), (3, 60)]  # of two evaluations; the last one counts
    (directory / "eval.csv").write_text("step,game,score,length\n" + "".join(f"1024,{n},{s},99\n" for n, s in games))
    (path,) = collect.collect(tmp_path)
    record = json.loads((path / "run.json").read_text())
    assert (path, record["source"]) == (tmp_path / "runs" / "CartPole-v1__acppo__7", "CartPole-v1__acppo__7__1")
    known = {"variant": "acppo", "game": "CartPole-v1", "seed": 7, "note": "", "steps": 2048, "versions": VERSIONS}
    known |= {"commit": "abc", "machine": "a machine", "command": "ppo_atari.py"}
    known |= {"evaluation": {"games": 3, "mean": 30, "std": 26.4575}}
    assert record | known | {"arguments": make_arguments("acppo", "CartPole-v1", 7)} == record
    rows = pd.read_csv(path / "curve.csv.gz", dtype=str)
    assert list(rows.columns) == ["step", *collect.TAGS, "games_ended"]
    assert list(rows.kl) == ["0.333333", "3.33333e-06"] and list(rows.mean_return_100) == ["9", "10"]
    assert (path / "curve.csv.gz").read_bytes()[4:8] == bytes(4)  # gzip's time of writing
    (path / "curve.csv.gz").write_bytes(gzip.compress(b"step,kl,games_ended\n1024,0.5,3\n"))
    (curve,) = collect.read_runs(tmp_path)[1].values()  # of an older run, which lacks what is newer
    assert list(curve.columns) == [*collect.TAGS, "games_ended"] and curve.kl[1024] == 0.5


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


def test_interval_is_that_of_all_ways_to_redraw_seeds_within_games():
    strata = [np.array([0.1, 0.5, 0.4]), np.array([1.0, 3.0, 1.7])]
    ways = [list(itertools.product(values, repeat=3)) for values in strata]  # 27 × 27, equally likely
    means = sorted(claims.interquartile_mean(np.array(one + other)) for one, other in itertools.product(*ways))
    low, high = claims.bootstrap_interval(strata)  # 2 to 3 % of the 729 lie below it, and as many above it
    assert means[14] - 1e-9 < low < means[21] + 1e-9 and means[-22] - 1e-9 < high < means[-15] + 1e-9
    # Across games 0 and 10 would mix; within a game there is nothing to mix
    assert claims.bootstrap_interval([np.zeros(3), np.full(3, 10.0)]) == (5, 5)
    assert claims.bootstrap_interval([np.zeros(3), np.zeros(1)]) is None


def test_interval_of_three_pairs_excludes_0_one_time_in_ten(monkeypatch):
    """For two equal algorithms a 95 % interval should do so one time in twenty; the texts say ten."""
    monkeypatch.setattr(claims, "DRAWS", 1000)
    generator = np.random.default_rng(1)
    intervals = [claims.bootstrap_interval(list(generator.standard_normal((5, 3)))) for _ in range(1000)]
    assert 0.08 < np.mean([low > 0 or high < 0 for low, high in intervals]) < 0.12


def test_stages_compare_each_game_at_one_step():
    pong = {("ppo", "Pong", 1): 100, ("acppo", "Pong", 1): 90, ("ppo", "Pong", 2): 88, ("acppo", "Pong", 2): 44}
    lengths = {("ppo", "Qbert", 1): 3, **pong, ("ppo", "Pong", 3): 43}
    finished, unfinished = make_stages({key: {"kl": range(length)} for key, length in lengths.items()})
    assert (finished.name, unfinished.name) == ("finished", "unfinished")
    assert list(finished.drawn) == [("ppo", "Pong", 1), ("acppo", "Pong", 1)]
    assert [list(curve.kl) for curve in finished.compared.values()] == [list(range(90))] * 2
    # The figures show them as far as the longest unfinished one, a finished one's first steps too
    drawn, compared = ({key: len(curve) for key, curve in c.items()} for c in (unfinished.drawn, unfinished.compared))
    assert drawn == {**lengths, ("ppo", "Pong", 1): 88, ("acppo", "Pong", 1): 88}
    assert compared == {**dict.fromkeys(pong, 44), ("ppo", "Qbert", 1): 3}
    assert "being shorter than half of their game's longest: Pong ppo 3." in report.coverage(unfinished)
    assert "2 runs, at 90 % to 100 % of a schedule of 102,400 agent steps. All in float32." in report.coverage(finished)
    unfinished.runs["ppo", "Pong", 3]["versions"] = {"script": "another"}
    assert "Some runs of a variant were trained by different versions" in report.coverage(unfinished)


def test_spike_rates_are_as_counted_by_hand():
    ppo, acppo = [1] * 93 + [9] * 2 + [20] * 5, [1] * 97 + [30] * 3  # 99th percentile of the first 20, medians 1
    (stage,) = make_stages({("ppo", "Pong", 1): {"kl": ppo}, ("acppo", "Pong", 1): {"kl": acppo}})
    margins = {"score": 0, "KL": math.log(2.11 / 1.87), "relative spikes": 0 - 0.03, "own spikes": 0.05 - 0.03}
    found = {claim: of["Pong"].item() for claim, of in claims.find_margins(stage).items()}
    assert found == pytest.approx({**margins, "clip ratio": 0.02})
    ppo_row, acppo_row = cells(report.kl_table(stage))[2:]
    # The TV distance is 0.1: above PPO's 0.1 / 2, above AC-PPO's 0.16 / 2
    assert ppo_row == ["Pong", "ppo", "1", "102,400", "2.11", "1", "20", "20", "0.00%", "5.00%", "100.00%", "0.1000"]
    assert acppo_row[4:] == ["1.87", "1", "30", "30", "3.00%", "3.00%", "100.00%", "0.1000"]
    seeds = {("ppo", "Pong", 1): {"kl": [1] * 100}, ("ppo", "Pong", 2): {"kl": [1] * 90 + [9] * 10}}
    assert claims.spike_limit(make_stages(seeds)[0], "Pong") == 9  # of all seeds


def test_a_claim_holds_on_a_game_where_three_pairs_all_agree():
    differences = ([1, 2, 3], [-1, -2, -3], [1, 2, -3], [1, 2, 0], [1, 2], [math.nan, 1, 1, 1])
    tables = [cells(report.claims_table(make_pairs({"Pong": of_game}))) for of_game in differences]
    judged = ["✓ 3 of 3", "✗ 0 of 3", "? 2 of 3", "? 2 of 3, 1 equal", "? 2 of 2", "✓ 3 of 3"]
    assert [table[2] for table in tables] == [["AC-PPO's final score is above PPO's", cell, "–"] for cell in judged]


@pytest.mark.parametrize(("breakout", "sign"), [([1, 2, 3], "✓ holds"), ([-4, -5, -6], "?"), ([1, 2], "?")])
def test_a_claim_is_judged_across_games_by_its_interval(breakout, sign):
    judged = sign if sign != "?" else f"? {claims.UNDECIDED}"
    stage = make_pairs({"Pong": [5, 6, 7], "Breakout": breakout, "CartPole-v1": [9, 9, 9]})
    strata = [np.array(breakout) / (30.5 - 1.7), np.array([5, 6, 7]) / (14.6 + 20.7)]  # CartPole has no human score
    mean, interval = claims.interquartile_mean(np.concatenate(strata)), claims.bootstrap_interval(strata)
    shown = "{:+.3f} of human minus random score ({:+.3f} to {:+.3f})".format(mean, *interval)
    assert cells(report.claims_table(stage))[2][-1] == f"{judged}: {shown}"
    assert cells(report.human_table(stage))[-1][3] == f"{mean:.3f}"


def test_a_final_score_waits_for_90_percent_of_the_schedule():
    stages = [make_pairs({"Pong": [5, 6, 7], "Breakout": [1, 2, 3]}, iterations) for iterations in (2, 3)]
    (score, *others), (early, *early_others) = (cells(report.claims_table(stage))[2:] for stage in stages)
    assert score[1] == "✓ 3 of 3" and early[1:] == ["too early"] * 3 and others == early_others
    assert ["(human − random)" in report.results_part([stage]) for stage in stages] == [True, False]
    shorts = [cells(report.short_table(shown))[2:] for shown in (stages, stages[1:])]  # the first stage that has a game
    assert [row[-1] for rows in shorts for row in rows] == ["✓ 3 of 3 pairs"] * 2 + ["too early"] * 2


@pytest.mark.parametrize(
    ("baseline", "challenger", "base", "new", "near", "signs"),
    [
        ("ppo", "acppo", "PPO", "AC-PPO", "0.1 (0.08 to 0.12)", "✗✗✗?✓"),
        ("ppo", "mine", "PPO", "mine", "0.1 (0.08 to 0.12)", "✓✓??✗"),
        ("mine", "ppo", "mine", "PPO", "0.2 (0.18 to 0.22)", "✗✗✗?✗"),
        ("product", "ppo", "product", "PPO", "which no run has", "✗✗✗??"),  # c = inf
        ("without", "ppo", "without", "PPO", "which no run has", "✗✗✗??"),  # of a script that has no ε
    ],
)
def test_verdicts_are_on_the_variants_that_are_named(baseline, challenger, base, new, near, signs):
    columns = {"ppo": ([0, 10], [1, 5], 0.1), "acppo": ([0, 9], [6, 6], 0.11)}
    columns |= dict.fromkeys(("mine", "product", "without"), ([0, 12], [1, 1], 0.13))
    columns = {name: dict(zip(("mean_return_100", "kl", "avg_clip_ratio"), of)) for name, of in columns.items()}
    runs = {(variant, "Pong", seed): columns[variant] for variant in columns for seed in (1, 2, 3)}
    (stage,) = make_stages(runs, baseline=baseline, challenger=challenger)
    rows = cells(report.claims_table(stage))[2:]
    assert rows[0][0] == f"{new}'s final score is above {base}'s"
    assert rows[-1][0] == f"{new}'s average clip ratio is near {base}'s ε, {near}"
    assert "".join(row[1][0] for row in rows) == signs
    assert f"| {challenger} − {baseline}, by pairs |" in report.results_part([stage])
    lines = figures.draw_figure("avg_clip_ratio", stage).axes[0].lines
    dashed = [(str(line.get_ydata()[0]), line.get_color()) for line in lines if line.get_linestyle() == "--"]
    assert dashed == ([] if near[0] == "w" else [(near.split()[0], figures.colour(stage.drawn, baseline))])


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
    assert list(score[2 : 2 + ended]) == [str(schedule * i // 10 - 1) for i in range(1, ended + 1)]
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
        for variant in ("ppo", "mine"):
            make_training(tmp_path, variant, started=started, mean_return_100=[1, 2], kl=[0.1, 0.2])
        call_main(report, "--out", ".", *flags)
        made = contents(tmp_path)
        assert before.items() <= made.items()
        call_main(report, "--out", ".", *flags)
        assert contents(tmp_path) == made
    assert made.keys() > {f"figures/{of}unfinished/{name}.png" for name in figures.FIGURES for of in ("", "spo-")}
    assert all("| CartPole-v1 | mine |" in made[page].decode() for page in ("README.md", "spo.md"))


def test_bad_input_is_refused_in_one_line(tmp_path, call_main):
    collect.collect(tmp_path, [make_training(tmp_path / "elsewhere", kl=[1], mean_return_100=[1])])
    (tmp_path / "README.md").write_text("<!-- end results -->\n<!-- results -->\n")  # nothing in between
    flags = {"--note none": "the note none", "--note a/b": "letters", "--challenger x": "one of ppo", "": "between"}
    for given, words in flags.items():
        assert words in refusal(call_main, report, "--out", ".", *given.split())


def test_the_committed_pages_are_what_report_makes_of_the_runs(tmp_path, monkeypatch, call_main):
    out, pages = tmp_path / "results", [ROOT / "README.md", *collect.DEFAULT_OUT.glob("*.md")]
    shutil.copytree(collect.DEFAULT_OUT / "runs", out / "runs")
    for page in pages:
        text = re.sub("(?<=<!-- results -->\n).*?(?=<!-- end)", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        (tmp_path / page.relative_to(ROOT)).write_text(text, encoding="utf-8")
    monkeypatch.setattr(report, "ROOT", tmp_path)
    monkeypatch.setattr(report, "DEFAULT_OUT", out)
    monkeypatch.setattr(report, "draw", lambda stage, directory: None)
    for flags in ("", "--note 83-percent", "--note spo --challenger spo"):
        call_main(report, "--out", "results", *flags.split())
    for page in pages:
        assert (tmp_path / page.relative_to(ROOT)).read_bytes() == page.read_bytes(), "run benchmark/report.py"
    linked = [name for page in pages[1:] for name in re.findall(r"\((figures/.*?)\)", page.read_text(encoding="utf-8"))]
    committed = (collect.DEFAULT_OUT / "figures").rglob("*.*")
    assert sorted(linked) == sorted(path.relative_to(collect.DEFAULT_OUT).as_posix() for path in committed)
