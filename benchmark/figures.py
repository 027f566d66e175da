"""The thesis's figures and tables, and what becomes of its claims, from the event files of `benchmark/atari5.py`.

    python benchmark/figures.py
    python benchmark/figures.py --out /tmp/another-grid

Two steps. `collect` reads every run directory under OUT/runs into OUT/runs.csv, a row a run, and OUT/curves.csv, a row
an iteration; runs that are in them already and have no directory here keep their rows, so that grids of several
machines add up. `draw` makes the rest from those two files alone: OUT/figures/*.png and *.svg, OUT/tables.md, and the
results in the README. A thesis-sized run takes three seconds to read, the drawing of all thirty half a minute.

What is compared: of each game, the runs that are at least half as long as its longest, all cut at the last step that
all of them have reached. The figures show every run as far as it got.

How the thesis's claims are judged. A pair is a run of `ppo` and one of `acppo` with the same game and seed. Each pair
has a margin for each claim, above 0 where it has the claim's sign:
    score            final `mean_return_100`, acppo - ppo (across games in units of human minus random score)
    KL               log of the ratio of the means of `losses/kl`, ppo / acppo
    relative spikes  share of iterations with a KL above the 99th percentile of ppo's in the same game (all its seeds),
                     ppo - acppo
    own spikes       share of iterations with a KL above ten times the run's own median, ppo - acppo
    clip ratio       0.02 - |mean of `losses/avg_clip_ratio` - 0.1|, so above 0 from 0.08 to 0.12; of acppo's runs alone
On one game a claim holds where every margin is above 0, and does not hold where every margin is below 0; else the two
cannot be told apart with these runs. Across games the same is asked of both ends of the 95 % interval of the
interquartile mean of all margins. With fewer than three pairs, on the game or on any of the games, the two cannot be
told apart at all: of two equal algorithms two pairs agree every second time, three still every fourth. This rule was
committed eight minutes into the first two of the runs (8073f69), before any had ended; that all runs of a game are cut
at one step, not each pair at its own, was added when the seeds had come to different lengths.

The interquartile mean is the mean of the middle half of the sorted values, those on its border counting with the part
of them that is inside (scipy's trim_mean counts them whole). Its interval is the percentile bootstrap that draws seeds
with replacement within each game. From three seeds it is too narrow: of two equal algorithms, three normal pairs on
each of five games, it excludes 0 one time in ten, not in twenty (tests/test_figures.py counts). It never is a plain
mean: the human score of DoubleDunk is 2.2 points above random.
"""

import itertools
import json
import math
import os
import re
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for wrappers.py, where nothing is installed
from wrappers import FRAME_SKIP, find_atari_game, refuse

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_OUT = ROOT / "benchmark" / "results"
MARKERS = ("<!-- results -->", "<!-- end results -->")

LOSSES = "kl old_approx_kl avg_clip_ratio clipfrac tv_distance max_tv_distance max_ratio_advantage".split()
TAGS = {"mean_return_100": "charts/mean_return_100", **{name: f"losses/{name}" for name in LOSSES}}
KEY = ["variant", "game", "seed"]
RUN_COLUMNS = [*KEY, *"steps total_timesteps command arguments commit versions machine threads".split()]
CURVE_COLUMNS = [*KEY, "step", *TAGS, "games_ended"]  # the last: since the start
PLACE = ("commit", "machine", "threads")  # what of a run's provenance has a column of its own; the rest are versions

FEWEST_PAIRS = 3
UNDECIDED = "cannot be told apart with these runs"
# Claim → what it says; how a margin across games is written, and what is said of it
CLAIMS = {
    "score": ("AC-PPO's final score is above PPO's", "{:+.3f}".format, "{} of human minus random score"),
    "KL": (
        "AC-PPO's KL between policy updates is smaller",
        lambda margin: f"{math.exp(margin):.2f}",
        "PPO's mean KL is {} times AC-PPO's",
    ),
    "relative spikes": (
        "AC-PPO has fewer KL spikes above the 99th percentile of PPO's",
        "{:+.2%}".format,
        "{} of all iterations",
    ),
    "own spikes": (
        "AC-PPO has fewer KL spikes above ten times the run's own median",
        "{:+.2%}".format,
        "{} of all iterations",
    ),
    "clip ratio": ("AC-PPO's average clip ratio is near 0.1 (0.08 to 0.12)", "{:+.4f}".format, "{} inside the band"),
}
SIGNS = {"holds": "✓", "does not hold": "✗", UNDECIDED: "?"}
DRAWS = 10_000  # of the bootstrap

# Figure → its title and the columns it shows, each with its y axis
FIGURES = {
    "score": ("Score, mean of the last 100 games", {"mean_return_100": "score, points"}),
    "kl": (
        "KL divergence between policy updates",
        {"kl": "exact KL, nats", "old_approx_kl": "the thesis's\nestimator, nats"},
    ),
    "avg_clip_ratio": ("Average clip ratio", {"avg_clip_ratio": "mean clip range"}),
    "tv_distance": (
        "Total variation distance between policy updates",
        {"tv_distance": "TV distance, mean", "max_tv_distance": "TV distance, max"},
    ),
    "ratio_advantage": (
        "Ratio deviation times advantage",
        {"max_ratio_advantage": "max |(ρ − 1)Â|"},
    ),
}
PPO_EPSILON = 0.1  # appendix A
# Okabe and Ito's colours, which colour-blind readers can tell apart
COLOURS = {"ppo": "#0072B2", "acppo": "#D55E00", "ppo-wide": "#56B4E9", "product": "#009E73"}
SPARE_COLOURS = ("#CC79A7", "#E69F00", "#000000")  # of other variants, by name; then again with other dashes
DASHES = ("-", "--", ":", "-.")

Curves = dict[tuple[str, str, int], pd.DataFrame]  # (variant, game, seed) → a row an iteration, by agent step


@dataclass
class Args:
    out: Path = DEFAULT_OUT
    """directory of the grid: its runs are in OUT/runs, and everything made of them is written beside that"""
    readme: Path | None = None
    """file whose text between `<!-- results -->` and `<!-- end results -->` becomes the results; by default the
    project's README.md for the default grid, and none for another"""


# ----------------------------------------------------------------------------------------------------- collect
def collect(out: Path) -> None:
    """Brings OUT/runs.csv and OUT/curves.csv up to date with the run directories under OUT/runs."""
    if not (out / "runs").is_dir():
        return
    found: dict[tuple, tuple[str, dict, pd.DataFrame]] = {}
    for directory in sorted(path for path in (out / "runs").iterdir() if path.is_dir()):
        try:
            run, curve = read_run(directory)
        # Whatever something that is not as it should be raises
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            print(f"{directory}: left out ({type(error).__name__}: {error})", file=sys.stderr)
            continue
        key = tuple(run[name] for name in KEY)
        if key in found:
            other, kept, _ = found[key]
            names = (other, directory.name) if kept["steps"] > run["steps"] else (directory.name, other)
            print(f"{' '.join(map(str, key))}: {names[0]} counts, {names[1]} got no further", file=sys.stderr)
        if key not in found or run["steps"] >= found[key][1]["steps"]:
            found[key] = (directory.name, run, curve)

    if not found:
        return
    runs, curves = read_csvs(out)
    for *key, before in runs[[*KEY, "steps"]].itertuples(index=False):
        if tuple(key) in found and before > (steps := found[tuple(key)][1]["steps"]):
            print(f"{' '.join(map(str, key))}: {steps} steps replace {before}", file=sys.stderr)
    new_runs = pd.DataFrame([run for _, run, _ in found.values()], columns=RUN_COLUMNS)
    new_curves = pd.concat([curve for _, _, curve in found.values()])
    for name, known, new in (("runs.csv", runs, new_runs), ("curves.csv", curves, new_curves)):
        kept = known[[key not in found for key in known[KEY].itertuples(index=False, name=None)]]
        table = pd.concat([kept, new]) if len(kept) else new
        table = table.sort_values(list(table.columns[:4]))  # the key and the step: a small diff
        table.to_csv(out / f"{name}.new", index=False, float_format="%.6g", lineterminator="\n")
        os.replace(out / f"{name}.new", out / name)  # at no time are rows that nobody else has in no file


def read_run(directory: Path) -> tuple[dict, pd.DataFrame]:
    """Returns a run's row of runs.csv and its rows of curves.csv."""
    record = json.loads((directory / "args.json").read_text())
    args, readers = record["args"], read_events(directory)
    key = dict(zip(KEY, (args["exp_name"], args["env_id"], args["seed"])))
    curve = read_curve(readers)
    if not len(curve):
        raise ValueError("it has no iterations")
    # args.json has the last start's; where starts differ, each value counts once
    starts = read_provenance(readers) or [record["provenance"]]
    provenance = {
        name: "; ".join(dict.fromkeys(str(start.get(name, "unknown")) for start in starts))
        for name in record["provenance"]
    }
    versions = {name: version for name, version in provenance.items() if name not in PLACE}
    run = {
        **key,
        "steps": int(curve.index[-1]),
        "total_timesteps": args["total_timesteps"],
        # Without the directory that it was logged to: a path of one machine, which tells nothing of the run
        "command": re.sub(r" --log-dir ('[^']*'|\S+)", "", record["command"]),
        "arguments": json.dumps({name: value for name, value in args.items() if name != "log_dir"}),
        "versions": json.dumps(versions),
        **{name: provenance[name] for name in PLACE},
    }
    return run, curve.reset_index().assign(**key)[CURVE_COLUMNS]


def read_events(directory: Path) -> list[EventAccumulator]:
    """Reads a run's event files, every point of them."""
    files = sorted(directory.glob("events.out.tfevents*"))
    return [EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload() for file in files]


def read_curve(readers: list[EventAccumulator]) -> pd.DataFrame:
    """Returns the tags in TAGS by agent step, and the games ended so far; of a step logged twice, the last."""
    points, game_ends = [], []
    for reader in readers:
        logged = reader.Tags()["scalars"]
        for column, tag in TAGS.items():
            if tag in logged:
                points += [(event.wall_time, event.step, column, event.value) for event in reader.Scalars(tag)]
        if "charts/episodic_return" in logged:
            game_ends += [event.step for event in reader.Scalars("charts/episodic_return")]
    points.sort(key=lambda point: point[0])
    table = pd.DataFrame(points, columns=["time", "step", "column", "value"])
    table = table.drop_duplicates(["step", "column"], keep="last")
    table = table.pivot(index="step", columns="column", values="value").reindex(columns=list(TAGS)).sort_index()
    return table.assign(games_ended=np.searchsorted(np.sort(game_ends), table.index, side="right"))


def read_provenance(readers: list[EventAccumulator]) -> list[dict[str, str]]:
    """Returns what each start of a run wrote of itself to TensorBoard, from the first to the last."""
    tag, texts = "provenance/text_summary", []
    for reader in readers:
        texts += reader.Tensors(tag) if tag in reader.Tags()["tensors"] else []
    tables = [text.tensor_proto.string_val[0].decode() for text in sorted(texts, key=lambda text: text.wall_time)]
    return [dict(line.strip("|").split("|", 1) for line in table.splitlines()) for table in tables]


def read_csvs(out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Returns OUT/runs.csv and OUT/curves.csv, without rows where there are none yet."""
    tables = []
    numbers = dict.fromkeys(("seed", "steps", "total_timesteps", "step", "games_ended"), "int64")
    numbers |= dict.fromkeys(TAGS, "float64")
    for name, columns in (("runs.csv", RUN_COLUMNS), ("curves.csv", CURVE_COLUMNS)):
        types = {column: numbers.get(column, "str") for column in columns}
        try:
            table = pd.read_csv(out / name, dtype=types)
        except FileNotFoundError:
            table = pd.DataFrame({column: pd.Series(dtype=dtype) for column, dtype in types.items()})
        except (OSError, ValueError) as error:
            refuse("out", out / name, f"cannot be read ({str(error).splitlines()[0]})")
        if list(table) != columns:
            refuse("out", out / name, "has other columns than this script writes; move it away")
        tables.append(table)
    return tuple(tables)


# -------------------------------------------------------------------------------------------------- statistics
def by_run(curves: pd.DataFrame) -> Curves:
    return {key: rows.set_index("step").drop(columns=KEY) for key, rows in curves.groupby(KEY)}


def variants(curves: Curves) -> list[str]:
    """Returns the variants' names, the thesis's two first."""
    order = list(COLOURS)
    names = {variant for variant, _, _ in curves}
    return sorted(names, key=lambda name: (order.index(name) if name in order else len(order), name))


def games(curves: Curves) -> list[str]:
    return sorted({game for _, game, _ in curves})


def seeds(curves: Curves, variant: str, game: str) -> dict[int, pd.DataFrame]:
    return {key[2]: curve for key, curve in curves.items() if key[:2] == (variant, game)}


def comparable(curves: Curves) -> Curves:
    """Returns the curves that tables and claims compare: of each game, those at least half as long as its longest, up
    to the last step that all of these have reached."""
    compared = {}
    for game in games(curves):
        of_game = {key: curve for key, curve in curves.items() if key[1] == game}
        longest = max(curve.index[-1] for curve in of_game.values())
        of_game = {key: curve for key, curve in of_game.items() if curve.index[-1] >= longest / 2}
        end = min(curve.index[-1] for curve in of_game.values())
        compared |= {key: curve.loc[:end] for key, curve in of_game.items()}
    return compared


def read_scores(of_games: list[str]) -> pd.DataFrame:
    """Returns the rows of scores.csv for these games; agent steps are 0 for the scores of humans and random play."""
    scores = pd.read_csv(Path(__file__).parent / "scores.csv").fillna({"agent_steps": 0, "note": ""})
    return scores[scores.game.isin(of_games)].astype({"agent_steps": int})


def human_ranges(of_games: list[str]) -> dict[str, tuple[float, float]]:
    """Returns the random score of each of these games that has one, and how far the human score is above it."""
    table = read_scores(of_games).pivot_table(index="game", columns="source", values="score_mean")
    return {game: (row["random"], row["human"] - row["random"]) for game, row in table.iterrows()}


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """(..., n) → (...): the mean of the middle half; a value on its border counts with its part inside."""
    borders = np.linspace(0, 1, values.shape[-1] + 1)  # value i of the sorted ones covers borders[i] to borders[i + 1]
    weights = 2 * np.diff(borders.clip(0.25, 0.75))
    return np.sort(values, axis=-1) @ weights


def bootstrap_interval(strata: list[np.ndarray]) -> tuple[float, float] | None:
    """Returns the 95 % interval of the interquartile mean of all games' values (seeds,), seeds redrawn within a game.

    None where a game has one seed: drawing from it gives itself, an interval without the width that seeds have.
    """
    if min(map(len, strata)) < 2:
        return None
    generator = np.random.default_rng(0)  # the same runs give the same interval
    drawn = [generator.choice(values, (DRAWS, len(values))) for values in strata]
    low, high = np.quantile(interquartile_mean(np.concatenate(drawn, axis=1)), [0.025, 0.975])
    return float(low), float(high)


def spike_limit(curves: Curves, game: str) -> float:
    """Returns the 99th percentile of the KL of all of ppo's runs, NaN where there are none."""
    kl = [curve.kl for curve in seeds(curves, "ppo", game).values()]
    return float(np.quantile(pd.concat(kl), 0.99)) if kl else math.nan


def share_above(values: pd.Series, limit: float) -> float:
    return float((values > limit).mean()) if math.isfinite(limit) else math.nan


def share_of_own_spikes(kl: pd.Series) -> float:
    return share_above(kl, 10 * kl.median())


def find_margins(curves: Curves) -> dict[str, dict[str, np.ndarray]]:
    """Returns claim → game → (pairs,) by the rule in this file's docstring, without pairs where no game has ended."""
    margins = {claim: {} for claim in CLAIMS}
    for game in games(curves):
        ppos, acppos = seeds(curves, "ppo", game), seeds(curves, "acppo", game)
        limit = spike_limit(curves, game)
        pairs = [(ppos[seed], acppos[seed]) for seed in sorted(ppos.keys() & acppos.keys())]
        of_game = {
            "score": [acppo.mean_return_100.iloc[-1] - ppo.mean_return_100.iloc[-1] for ppo, acppo in pairs],
            "KL": [np.log(ppo.kl.mean()) - np.log(acppo.kl.mean()) for ppo, acppo in pairs],
            "relative spikes": [share_above(ppo.kl, limit) - share_above(acppo.kl, limit) for ppo, acppo in pairs],
            "own spikes": [share_of_own_spikes(ppo.kl) - share_of_own_spikes(acppo.kl) for ppo, acppo in pairs],
            "clip ratio": [0.02 - abs(acppo.avg_clip_ratio.mean() - 0.1) for acppo in acppos.values()],
        }
        for claim, values in of_game.items():
            margins[claim][game] = np.array([value for value in values if math.isfinite(value)])
    return margins


def verdict(fewest: int, low: float, high: float) -> str:
    """Judges margins, or the interval of their interquartile mean, that lie between `low` and `high`."""
    if fewest < FEWEST_PAIRS or low <= 0 <= high:
        return UNDECIDED
    return "holds" if low > 0 else "does not hold"


# ------------------------------------------------------------------------------------------------------ tables
def markdown(columns: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [columns, ["-"] * len(columns), *rows]) + "\n"


def plus_minus(mean: float, std: float) -> str:
    return f"{mean:,.1f}" + (f" ± {std:,.1f}" if math.isfinite(std) else "")


def final_scores(curves: Curves, variant: str, game: str) -> np.ndarray:
    """Returns the last `mean_return_100` of each seed that has ended a game (seeds,)."""
    last = [curve.mean_return_100.iloc[-1] for curve in seeds(curves, variant, game).values()]
    return np.array([score for score in last if math.isfinite(score)])


def score_table(curves: Curves) -> str:
    """Our final scores beside published ones."""
    scores = read_scores(games(curves))
    published = {key: rows.set_index("game") for key, rows in scores.groupby(["agent_steps", "source"], sort=False)}
    table = []
    for game in games(curves):
        row = [game, f"{next(curve for key, curve in curves.items() if key[1] == game).index[-1]:,}"]
        for variant in variants(curves):
            if len(final := final_scores(curves, variant, game)):
                std = final.std(ddof=1) if len(final) > 1 else math.nan
                fewest = min(curve.games_ended.iloc[-1] for curve in seeds(curves, variant, game).values())
                of_games = f", {fewest} games" if fewest < 100 else ""
                row.append(f"{plus_minus(final.mean(), std)} (n = {len(final)}{of_games})")
            else:
                row.append("–")
        for lines in published.values():
            given = game in lines.index
            row.append(plus_minus(*lines.loc[game, ["score_mean", "score_std"]]) if given else "–")
        table.append(row)
    headings = [source + (f", {steps:,}" if steps else "") for steps, source in published]
    notes = dict.fromkeys(f"{row.source}: {row.note}" for row in scores[scores.note.ne("")].itertuples())
    text = (
        "Mean score of the last 100 games at the agent step given (on Atari 4 frames each): mean ± sample standard"
        " deviation (ddof 1) over n seeds. Where a seed had ended fewer than 100 games, the fewest are given, and its"
        " mean is over all since the start, without the long ones that had not ended."
    )
    if published:
        text += f" Published scores stand under their source and its agent steps ({'; '.join(notes)})."
    return markdown(["game", "agent steps", *variants(curves), *headings], table) + f"\n{text}\n"


def in_human_ranges(margins: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns differences of scores in units of human minus random score, of the games that have these."""
    ranges = human_ranges(list(margins))
    return {game: values / ranges[game][1] for game, values in margins.items() if game in ranges}


def mean_and_interval(strata: list[np.ndarray], number=lambda value: f"{value:.3f}") -> tuple[str, str]:
    interval = bootstrap_interval(strata)
    text = "no interval: one seed" if interval is None else " to ".join(map(number, interval))
    return number(interquartile_mean(np.concatenate(strata))), text


def human_table(curves: Curves) -> str:
    """Interquartile means of human-normalised scores."""
    ranges = human_ranges(games(curves))
    strata = {}
    for variant in variants(curves):
        finals = [(final_scores(curves, variant, game) - low) / height for game, (low, height) in ranges.items()]
        strata[variant] = [final for final in finals if len(final)]
    pairs = in_human_ranges(find_margins(curves)["score"]).values()
    strata["acppo − ppo, by pairs"] = [values for values in pairs if len(values)]
    table = []
    for name, finals in strata.items():
        if finals:
            counts = ", ".join(str(n) for n in sorted(set(map(len, finals))))
            table.append([name, str(len(finals)), counts, *mean_and_interval(finals)])
    if not table:
        return "None: `benchmark/scores.csv` has no human score of these games.\n"
    return markdown(["", "games", "seeds", "interquartile mean", "95 % interval"], table) + (
        "\nFinal scores as above, (score − random) / (human − random), over games × seeds; the interval draws seeds"
        "\nwithin each game. Pairs have game and seed in common.\n"
    )


def kl_table(runs: pd.DataFrame, curves: Curves) -> str:
    """How far an update moves the policy, over all iterations of all seeds."""
    table = []
    for game, variant in itertools.product(games(curves), variants(curves)):
        if not (of_seeds := list(seeds(curves, variant, game).values())):
            continue
        together = pd.concat(of_seeds)
        numbers = (together.kl.mean(), together.kl.median(), together.kl.quantile(0.99), together.kl.max())
        shares = (
            share_above(together.kl, spike_limit(curves, game)),
            np.mean([share_of_own_spikes(curve.kl) for curve in of_seeds]),
            share_above(together.max_tv_distance, epsilons(runs).get(variant, math.nan) / 2),
        )
        row = [game, variant, str(len(of_seeds)), f"{of_seeds[0].index[-1]:,}"]
        row += [f"{number:.3g}" for number in numbers]
        row += [f"{share:.2%}" if math.isfinite(share) else "–" for share in shares]
        table.append([*row, f"{together.avg_clip_ratio.mean():.4f}"])
    columns = ["game", "variant", "seeds", "agent steps", "mean KL", "median", "99th percentile", "maximum"]
    columns += ["spikes: above ppo's 99th percentile", "spikes: above 10 × own median"]
    columns += ["largest TV distance above ε / 2", "average clip ratio"]
    return markdown(columns, table) + (
        "\nKL between policy updates (`losses/kl`, nats, exact over actions), every iteration of all seeds up to the"
        "\nagent step given; shares are of iterations. ppo's above its own 99th percentile is about 1 % by definition."
        "\nThe largest TV distance is over the visited states; ε / 2 bounds it only while every ratio is inside its"
        "\nrange (proposition 2.4.1).\n"
    )


def claims_table(curves: Curves) -> str:
    """A line for each claim of the thesis, judged by the rule in this file's docstring."""
    table = []
    for claim, margins in find_margins(curves).items():
        said, number, sentence = CLAIMS[claim]
        row = [said]
        for values in margins.values():
            judged = verdict(len(values), values.min(), values.max()) if len(values) else UNDECIDED
            ties = f", {(values == 0).sum()} equal" if (values == 0).any() else ""
            row.append(f"{SIGNS[judged]} {(values > 0).sum()} of {len(values)}{ties}")
        strata = list((in_human_ranges(margins) if claim == "score" else margins).values())
        if len(strata) > 1 and any(map(len, strata)):
            low, high = bootstrap_interval(strata) or (-math.inf, math.inf)
            judged = verdict(min(map(len, strata)), low, high)
            mean, interval = mean_and_interval(strata, number)
            row.append(f"{SIGNS[judged]} {judged}: {sentence.format(mean)} ({interval})")
        else:
            row.append("–")
        table.append(row)
    return markdown(["claim", *games(curves), "across games"], table)


def coverage(runs: pd.DataFrame, compared: Curves) -> str:
    """Says which runs the results are made of, and how much of their schedule they have done."""
    done = 100 * runs.steps / runs.total_timesteps
    share = " to ".join(dict.fromkeys(f"{percent:.3g} %" for percent in (done.min(), done.max())))
    names = {name: ", ".join(map(str, sorted(runs[name].unique()))) for name in KEY}
    commits = sorted({commit[:7] for of_run in runs.commit for commit in of_run.split("; ")})
    machines = sorted({machine for of_run in runs.machine for machine in of_run.split("; ")})
    schedules = " or ".join(f"{steps:,}" for steps in sorted(runs.total_timesteps.unique()))
    text = (
        f"{len(runs)} runs (variants {names['variant']}; games {names['game']}; seeds {names['seed']}), at {share} of a"
        f" schedule of {schedules} agent steps."
    )
    if done.min() < 99:
        text += " What stands here is so at these steps, and says nothing about the schedule's end."
    left_out = [
        f"{key[1]} {key[0]} {key[2]}" for key in runs[KEY].itertuples(index=False, name=None) if key not in compared
    ]
    if left_out:
        text += f" In the figures alone, being shorter than half of their game's longest run: {', '.join(left_out)}."
    return (
        f"{text} Commits {', '.join(commits)}; {', '.join(machines)}; each run's arguments, versions and whole commit"
        " are in `runs.csv`.\n"
    )


JUDGED = f"""The thesis's claims: ✓ holds, ✗ does not hold, ? {UNDECIDED}. A game is judged by
its pairs of ppo and acppo with the same seed (the clip ratio by runs of acppo): {FEWEST_PAIRS} or more must be there,
and all must agree; the table counts those with the claim's sign. Across games, the 95 % interval of the margins'
interquartile mean must exclude "no difference"; with three seeds a game it does so for two equal algorithms one
time in ten, not in twenty. The whole rule, and since when it stands, opens `benchmark/figures.py`.
"""


def tables_text(out: Path) -> str:
    """Returns OUT/tables.md."""
    runs, rows = read_csvs(out)
    curves = comparable(by_run(rows))
    parts = ["# Tables\n", "Made by `benchmark/figures.py` from `runs.csv` and `curves.csv`.\n", coverage(runs, curves)]
    parts += ["## Final score\n", score_table(curves), "## Human-normalised score\n", human_table(curves)]
    parts += ["## KL between policy updates, and clip ratio\n", kl_table(runs, curves), "## Claims\n", JUDGED]
    return "\n".join([*parts, claims_table(curves)])


def results_section(out: Path, readme: Path = ROOT / "README.md") -> str:
    """Returns what a README says about the results in OUT, its links relative to the README."""
    runs, rows = read_csvs(out)
    curves = by_run(rows)
    compared = comparable(curves)
    link = Path(os.path.relpath(out.resolve(), readme.resolve().parent)).as_posix()
    parts = [coverage(runs, compared)]
    tables_below = {
        "score": [score_table(compared), human_table(compared)],
        "kl": [kl_table(runs, compared), JUDGED, claims_table(compared)],
    }
    for name, tables in tables_below.items():
        parts += [f"![{FIGURES[name][0]}. {captions(runs, curves)[name]}]({link}/figures/{name}.png)\n", *tables]
    names = ", ".join(f"[{name}]({link}/figures/{name}.svg)" for name in FIGURES)
    parts += [f"All figures: {names}.\n"]
    return "\n".join(parts)


def split_readme(readme: Path) -> list[str] | None:
    """Returns what stands before and after the results, None where the file has no place for them."""
    try:
        parts = re.split(f"{MARKERS[0]}.*?{MARKERS[1]}", readme.read_text(), flags=re.DOTALL)
    except (OSError, UnicodeDecodeError):
        return None
    return parts if len(parts) == 2 else None


# ----------------------------------------------------------------------------------------------------- figures
def frames_per_step(game: str) -> int:
    """Returns the emulator frames of an agent step: 4 on Atari, 1 elsewhere, where a step is all there is."""
    return FRAME_SKIP if find_atari_game(game) else 1


def style(curves: Curves, variant: str) -> dict[str, str]:
    """Returns a variant's colour and dashes, the same in all figures."""
    if variant in COLOURS:
        return {"color": COLOURS[variant], "linestyle": "-"}
    others = [name for name in variants(curves) if name not in COLOURS]
    turn, colour = divmod(others.index(variant), len(SPARE_COLOURS))
    return {"color": SPARE_COLOURS[colour], "linestyle": DASHES[turn % len(DASHES)]}


def epsilons(runs: pd.DataFrame) -> dict[str, float]:
    """Returns each variant's ε, its widest clip range; with c = inf the range has no bound, and it has none here."""
    arguments = {run.variant: json.loads(run.arguments) for run in runs.itertuples()}
    return {name: args["clip_coef"] for name, args in arguments.items() if math.isfinite(args.get("c", 0))}


def captions(runs: pd.DataFrame, curves: Curves) -> dict[str, str]:
    """Returns figure → caption."""
    band = "One seed, so no band."
    if runs.seed.nunique() > 1:
        band = "Line and band: mean ± sample standard deviation (ddof 1) over the n seeds that a panel's title gives, "
        band += "as far as all of a variant's have got; thin: each seed. Where n = 1 there is no band."
    spikes = "Thin: every iteration of each seed. Thick: running median over a twentieth of them, then over a "
    spikes += "variant's seeds, as far as all have got."
    kl = pd.concat([curve.kl for curve in curves.values()]).median()
    args = json.loads(runs.arguments.iloc[0])
    samples = args["num_envs"] * args["num_steps"]
    noise = f"√(2 KL / {samples:,}), {math.sqrt(2 * kl / samples):.1g} at the median KL {kl:.1g}"
    bounds = ", ".join(f"{epsilon / 2:g} for {variant}" for variant, epsilon in epsilons(runs).items())
    estimator = f"the thesis's estimator, the mean of log π − log π_new over the {samples:,} actions taken"
    bound = "which bounds the maximum while every ratio is inside its range (proposition 2.4.1)"
    return {
        "score": band,
        "kl": "Top: exact over actions, mean over the rollout's states. "
        f"Bottom: {estimator}; its noise is about {noise}, so it can be negative. {spikes}",
        "avg_clip_ratio": f"Clip range, mean over an iteration's samples. Dashed: PPO's ε = {PPO_EPSILON}. {spikes}",
        "tv_distance": "Top: mean over the rollout's states. Bottom: its maximum over them. "
        f"Dashed, in the variant's colour: ε / 2 ({bounds}), {bound}. {spikes}",
        "ratio_advantage": f"Theorem 3.1.1's δ on the rollout's samples; Â normalised over the rollout. {spikes}",
    }


def draw_figure(name: str, caption: str, runs: pd.DataFrame, curves: Curves) -> Figure:
    """Draws a panel for each game: three in a line, or where the figure has two columns a line for each."""
    title, columns = FIGURES[name]
    two = len(columns) > 1
    across = len(games(curves)) if two else min(3, len(games(curves)))
    down = len(columns) * math.ceil(len(games(curves)) / across)
    width = max(9.0, (3.5 if two else 4.2) * across)  # inches
    figure = Figure(figsize=(width, 1.8 + 3.2 * down), layout="constrained", facecolor="white")
    sharey = False if name == "score" else "row" if two else True  # points of two games do not compare
    axes = figure.subplots(down, across, squeeze=False, sharey=sharey).flat
    for (column, label), game in itertools.product(columns.items(), games(curves)):
        axis = next(axes)
        counts = {variant: len(seeds(curves, variant, game)) for variant in variants(curves)}
        counts = {variant: n for variant, n in counts.items() if n}
        title_n = f" (n = {max(counts.values())})"
        if len(set(counts.values())) > 1:
            title_n = "\n(n = " + ", ".join(f"{n} {variant}" for variant, n in counts.items()) + ")"
        axis.set_title(game + title_n, fontsize="small")
        draw_panel(axis, curves, game, column)
        lines = {"ppo": PPO_EPSILON} if name == "avg_clip_ratio" else {}
        if name == "tv_distance":
            lines = {variant: epsilon / 2 for variant, epsilon in epsilons(runs).items() if variant in counts}
        for variant, value in lines.items():
            axis.axhline(value, color=style(curves, variant)["color"], linestyle="--", linewidth=1.5)
        axis.set_xlabel("emulator frames (4 a step)" if frames_per_step(game) == 4 else "agent steps")
        axis.set_ylabel(label if axis.get_subplotspec().is_first_col() else "")
        axis.set_xlim(left=0)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.locator_params(axis="x", nbins=4)
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
    for axis in axes:  # left over
        axis.set_axis_off()
    lines = [Line2D([], [], linewidth=3, label=variant, **style(curves, variant)) for variant in variants(curves)]
    figure.legend(handles=lines, title=title, loc="outside upper center", ncols=6, frameon=False)
    figure.supxlabel(textwrap.fill(caption, int(width * 11)), x=0.01, ha="left", fontsize="small")
    return figure


def draw_panel(axis: Axes, curves: Curves, game: str, column: str) -> None:
    """Draws one column of a game's runs, all variants."""
    for variant in variants(curves):
        table = pd.DataFrame({seed: curve[column] for seed, curve in seeds(curves, variant, game).items()})
        if table.empty:
            continue
        look, x = style(curves, variant), table.index * frames_per_step(game)
        if column == "mean_return_100":
            middle, std = table.mean(axis=1, skipna=False), table.std(axis=1, skipna=False)  # NaN for one seed
            axis.fill_between(x, middle - std, middle + std, color=look["color"], alpha=0.2, linewidth=0)
        else:  # has spikes, or noise from one iteration to the next
            window = max(1, len(table) // 20)
            running = table.rolling(window, center=True, min_periods=1).median()
            middle = running.where(table.notna()).median(axis=1, skipna=False)
        pixels = len(table) > 1000  # in the SVG too, where a line of 5,000 points in every panel makes megabytes
        axis.plot(x, table, color=look["color"], linewidth=0.6, alpha=0.4, rasterized=pixels)
        # A white edge against the mass of its own colour in long runs; a score's would hide the other variant
        edge = [] if column == "mean_return_100" else [withStroke(linewidth=4, foreground="white")]
        axis.plot(x, middle, linewidth=2, zorder=3, path_effects=edge, **look)
    if column == "old_approx_kl":  # has both signs: linear up to about its median size
        median = pd.concat([curve.kl for curve in curves.values()]).median()
        axis.set_yscale("symlog", linthresh=10.0 ** round(math.log10(median)) if median > 0 else 1)
    elif column not in ("mean_return_100", "avg_clip_ratio"):
        axis.set_yscale("log")


def draw(out: Path) -> None:
    """Makes OUT/figures and OUT/tables.md from OUT's two CSVs."""
    runs, rows = read_csvs(out)
    curves = by_run(rows)
    (out / "figures").mkdir(exist_ok=True)
    settings = {"font.size": 13, "legend.title_fontsize": 15, "savefig.dpi": 100, "svg.hashsalt": "acppo"}
    with matplotlib.rc_context({**matplotlib.rcParamsDefault, **settings}):  # whatever the user's matplotlibrc says
        for name, caption in captions(runs, curves).items():
            figure = draw_figure(name, caption, runs, curves)
            figure.savefig(out / "figures" / f"{name}.png")
            figure.savefig(out / "figures" / f"{name}.svg", metadata={"Date": None})  # equal CSVs give equal files
    (out / "tables.md").write_text(tables_text(out))


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    readme = args.readme or (ROOT / "README.md" if args.out.resolve() == DEFAULT_OUT else None)
    if args.readme and split_readme(args.readme) is None:
        refuse("readme", args.readme, f"has no {MARKERS[0]} … {MARKERS[1]}, once, to write between")
    try:
        if not (args.out / "runs").is_dir() and not (args.out / "curves.csv").exists():
            refuse("out", args.out, "has neither runs nor their CSVs; run benchmark/atari5.py first")
        collect(args.out)
        if not all(map(len, read_csvs(args.out))):
            refuse("out", args.out, "no run there has an iteration yet")
        draw(args.out)
        if readme and (parts := split_readme(readme)):
            readme.write_text(f"{MARKERS[0]}\n{results_section(args.out, readme)}{MARKERS[1]}".join(parts))
        elif readme:
            print(f"{readme}: left as it is, it has no {MARKERS[0]} … {MARKERS[1]}", file=sys.stderr)
    except OSError as error:
        refuse("out", args.out, f"cannot use {error.filename} ({error.strerror})")
    print(f"{args.out}: runs.csv, curves.csv, figures/, tables.md")


if __name__ == "__main__":
    main()
