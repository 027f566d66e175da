"""What becomes of the thesis's claims, and the tables: from the CSVs of `collect.py` alone, for `figures.py` to print.

Two stages are compared apart from each other. `finished`: of each game, the runs that have done 90 % of their schedule,
up to the last step that all of these have reached. `beginnings`: of each game that has an unfinished run, all runs that
are at least half as long as its longest unfinished one, up to the last step that all of these have reached; of a
finished run these are the first steps.

How a claim is judged. The thesis's baseline is `ppo`, its challenger `acppo`; two other variants can stand in their
places. A pair is a run of each with the same game and seed. Each pair has a margin for each claim, above 0 if it has
the claim's sign:
    score            final `mean_return_100`, challenger - baseline (across games in units of human minus random score)
    KL               log of the ratio of the means of `losses/kl`, baseline / challenger
    relative spikes  share of iterations with a KL above the 99th percentile of the baseline's in the same game (all its
                     seeds), baseline - challenger
    own spikes       share of iterations with a KL above ten times the run's own median, baseline - challenger
    clip ratio       0.02 - |mean of `losses/avg_clip_ratio` - the baseline's ε|, so for PPO's 0.1 above 0 from 0.08 to
                     0.12; of the challenger's runs alone
On one game a claim holds if every margin is above 0, and does not hold if every margin is below 0; else the two cannot
be told apart with these runs. Across games the same is asked of both ends of the 95 % interval of the interquartile
mean of all margins. With fewer than three pairs, on the game or on any of the games, the two cannot be told apart at
all: of two equal algorithms two pairs agree every second time, three still every fourth. In the beginnings it is too
early to judge a final score.

This rule was committed eight minutes into the first two of the runs (8073f69), before any had ended. Added since: that
all runs of a game are cut at one step, not each pair at its own (when the seeds had come to different lengths); the
stages, and that final scores wait for 90 % of the schedule (when one pair had finished, in which ppo scores more).

The interquartile mean is the mean of the middle half of the sorted values, those on its border counting with the part
of them that is inside (scipy's trim_mean counts them whole). Its interval is the percentile bootstrap that draws seeds
with replacement within each game. From three seeds it is too narrow: of two equal algorithms, three normal pairs on
each of five games, it excludes 0 one time in ten, not in twenty (tests/test_figures.py counts). It never is a plain
mean: the human score of DoubleDunk is 2.2 points above random.
"""

import itertools
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark.collect import KEY
from benchmark.readme import markdown

FINISHED = 0.9  # of its schedule
FEWEST_PAIRS = 3
UNDECIDED, TOO_EARLY = "cannot be told apart with these runs", "too early"
OF_ITERATIONS = ("{:+.2%}".format, "{} of all iterations")
# Claim → its sentence; the format of a margin across games, and the sentence around it
CLAIMS = {
    "score": ("{new}'s final score is above {base}'s", "{:+.3f}".format, "{} of human minus random score"),
    "KL": (
        "{new}'s KL between policy updates is smaller",
        lambda m: f"{math.exp(m):.2f}",
        "{base}'s mean KL is {} times {new}'s",
    ),
    "relative spikes": ("{new} has fewer KL spikes above the 99th percentile of {base}'s", *OF_ITERATIONS),
    "own spikes": ("{new} has fewer KL spikes above ten times the run's own median", *OF_ITERATIONS),
    "clip ratio": ("{new}'s average clip ratio is near {near}", "{:+.4f}".format, "{} inside the band"),
}
SPELLED = {"ppo": "PPO", "acppo": "AC-PPO"}  # the others' names are as they were given
SIGNS = {"holds": "✓", "does not hold": "✗", UNDECIDED: "?"}
DRAWS = 10_000  # of the bootstrap
VARIANT_ORDER = ("ppo", "acppo", "ppo-matched", "ppo-wide", "product")  # the thesis's two first; others by name

Key = tuple[str, str, int]  # variant, game, seed
Curves = dict[Key, pd.DataFrame]  # a row an iteration, by agent step


@dataclass
class Stage:
    name: str  # finished or beginnings
    runs: pd.DataFrame  # their rows of runs.csv
    drawn: Curves  # as far as the figures show them
    compared: Curves  # as the tables and claims compare them
    baseline: str
    challenger: str
    epsilon: float  # the baseline's, NaN if it has none

    @property
    def final(self) -> bool:
        return self.name == "finished"

    @property
    def long(self) -> bool:
        """Whether all have done half of their schedules, so that the course of each says something."""
        totals = total_timesteps(self.runs)
        return all(curve.index[-1] >= totals[key] / 2 for key, curve in self.compared.items())

    def words(self) -> dict[str, str]:
        """Returns what the texts call the two variants, and what the clip ratio is to be near to."""
        base, new = (SPELLED.get(variant, variant) for variant in (self.baseline, self.challenger))
        band = f"{self.epsilon:g} ({self.epsilon - 0.02:g} to {self.epsilon + 0.02:g})"
        near = (
            band if self.epsilon == 0.1 else f"{base}'s ε, {'which no run has' if math.isnan(self.epsilon) else band}"
        )
        return {"base": base, "new": new, "near": near}


def make_stages(runs: pd.DataFrame, curves: pd.DataFrame, baseline="ppo", challenger="acppo") -> list[Stage]:
    """Returns the stages that have runs, the finished one first."""
    totals = total_timesteps(runs)
    everything = {key: rows.set_index("step").drop(columns=KEY) for key, rows in curves.groupby(KEY)}
    finished = {key for key, curve in everything.items() if curve.index[-1] >= FINISHED * totals[key]}
    finals = [{key: everything[key] for key in finished if key[1] == game} for game in games(everything)]
    beginnings, compared = [], []
    for game in games(everything):
        of_game = {key: curve for key, curve in everything.items() if key[1] == game}
        if unfinished := of_game.keys() - finished:
            longest = max(of_game[key].index[-1] for key in unfinished)
            beginnings.append({key: curve.loc[:longest] for key, curve in of_game.items()})
            compared.append({key: curve for key, curve in beginnings[-1].items() if curve.index[-1] >= longest / 2})
    stages = []
    for name, drawn, of_games in (("finished", finals, finals), ("beginnings", beginnings, compared)):
        cut: Curves = {}
        for of_game in filter(None, of_games):
            end = min(curve.index[-1] for curve in of_game.values())
            cut |= {key: curve.loc[:end] for key, curve in of_game.items()}
        together = in_order({key: curve for of_game in drawn for key, curve in of_game.items()})
        if together:
            rows = runs.set_index(KEY).loc[list(together)].reset_index()
            epsilon = epsilons(runs).get(baseline, math.nan)
            stages.append(Stage(name, rows, together, in_order(cut), baseline, challenger, epsilon))
    return stages


def total_timesteps(runs: pd.DataFrame) -> dict[Key, int]:
    """The agent steps of each run's whole schedule."""
    return dict(zip(runs[KEY].itertuples(index=False, name=None), runs.total_timesteps))


def in_order(curves: Curves) -> Curves:
    """Sorts by game, variant and seed."""
    order = variants(curves)
    return dict(sorted(curves.items(), key=lambda item: (item[0][1], order.index(item[0][0]), item[0][2])))


def variants(curves: Curves) -> list[str]:
    names = {variant for variant, _, _ in curves}
    return [name for name in VARIANT_ORDER if name in names] + sorted(names - set(VARIANT_ORDER))


def games(curves: Curves) -> list[str]:
    return sorted({game for _, game, _ in curves})


def seeds(curves: Curves, variant: str, game: str) -> dict[int, pd.DataFrame]:
    return {key[2]: curve for key, curve in curves.items() if key[:2] == (variant, game)}


def pairs(stage: Stage, game: str) -> list[tuple[pd.DataFrame, pd.DataFrame]]:
    """Returns the curves of baseline and challenger, seed by seed."""
    base, new = (seeds(stage.compared, variant, game) for variant in (stage.baseline, stage.challenger))
    return [(base[seed], new[seed]) for seed in sorted(base.keys() & new.keys())]


def epsilons(runs: pd.DataFrame) -> dict[str, float]:
    """Returns each variant's ε, its widest clip range, if it has one; with c = inf the range has no bound."""
    arguments = {run.variant: json.loads(run.arguments) for run in runs.itertuples()}
    bounded = {name: args for name, args in arguments.items() if str(args.get("c")) != "inf"}
    return {name: args["clip_coef"] for name, args in bounded.items() if "clip_coef" in args}


# -------------------------------------------------------------------------------------------------- statistics
def read_scores(of_games: list[str]) -> pd.DataFrame:
    """Returns the rows of scores.csv for these games; agent steps are 0 for the scores of humans and random play."""
    scores = pd.read_csv(Path(__file__).parent / "scores.csv", encoding="utf-8").fillna({"agent_steps": 0, "note": ""})
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

    None if a game has one seed: drawing from it gives itself, an interval without the width that seeds have.
    """
    if min(map(len, strata)) < 2:
        return None
    generator = np.random.default_rng(0)  # the same runs give the same interval
    drawn = [generator.choice(values, (DRAWS, len(values))) for values in strata]
    low, high = np.quantile(interquartile_mean(np.concatenate(drawn, axis=1)), [0.025, 0.975])
    return float(low), float(high)


def spike_limit(stage: Stage, game: str) -> float:
    """Returns the 99th percentile of the KL of all of the baseline's runs, NaN if there are none."""
    kl = [curve.kl for curve in seeds(stage.compared, stage.baseline, game).values()]
    return float(np.quantile(pd.concat(kl), 0.99)) if kl else math.nan


def share_above(values: pd.Series, limit: float) -> float:
    return float((values > limit).mean()) if math.isfinite(limit) else math.nan


def share_of_own_spikes(kl: pd.Series) -> float:
    return share_above(kl, 10 * kl.median())


def find_margins(stage: Stage) -> dict[str, dict[str, np.ndarray]]:
    """Returns claim → game → (pairs,) by the rule that opens this file, without pairs in which no game has ended."""
    margins = {claim: {} for claim in CLAIMS}
    for game in games(stage.compared):
        both, limit = pairs(stage, game), spike_limit(stage, game)
        of_new = seeds(stage.compared, stage.challenger, game).values()
        of_game = {
            "score": [new.mean_return_100.iloc[-1] - base.mean_return_100.iloc[-1] for base, new in both],
            "KL": [np.log(base.kl.mean()) - np.log(new.kl.mean()) for base, new in both],
            "relative spikes": [share_above(base.kl, limit) - share_above(new.kl, limit) for base, new in both],
            "own spikes": [share_of_own_spikes(base.kl) - share_of_own_spikes(new.kl) for base, new in both],
            "clip ratio": [0.02 - abs(new.avg_clip_ratio.mean() - stage.epsilon) for new in of_new],
        }
        for claim, values in of_game.items():
            margins[claim][game] = np.array([value for value in values if math.isfinite(value)])
    return margins


def in_human_ranges(margins: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns differences of scores in units of human minus random score, of the games that have these."""
    ranges = human_ranges(list(margins))
    return {game: values / ranges[game][1] for game, values in margins.items() if game in ranges}


def verdict(fewest: int, low: float, high: float) -> str:
    """Judges margins, or the interval of their interquartile mean, that lie between `low` and `high`."""
    if fewest < FEWEST_PAIRS or low <= 0 <= high:
        return UNDECIDED
    return "holds" if low > 0 else "does not hold"


def judge(values: np.ndarray) -> str:
    """Returns the cell of a claim on a game: its sign, and how many of the margins have the claim's."""
    judged = verdict(len(values), values.min(), values.max()) if len(values) else UNDECIDED
    ties = f", {(values == 0).sum()} equal" if (values == 0).any() else ""
    return f"{SIGNS[judged]} {(values > 0).sum()} of {len(values)}{ties}"


# ------------------------------------------------------------------------------------------------------ tables
def plus_minus(mean: float, std: float) -> str:
    return f"{mean:,.1f}" + (f" ± {std:,.1f}" if math.isfinite(std) else "")


def over_seeds(values: np.ndarray) -> str:
    return plus_minus(values.mean(), values.std(ddof=1) if len(values) > 1 else math.nan)


def last_scores(of_seeds: dict[int, pd.DataFrame]) -> np.ndarray:
    """Returns the last `mean_return_100` of each seed that has ended a game (seeds,)."""
    last = [curve.mean_return_100.iloc[-1] for curve in of_seeds.values()]
    return np.array([score for score in last if math.isfinite(score)])


def last_step(curves: Curves, game: str) -> str:
    return f"{next(curve for key, curve in curves.items() if key[1] == game).index[-1]:,}"


def score_table(curves: Curves) -> str:
    """Our scores beside those of random and human play, and in a table of their own the published ones of trainings."""
    scores = read_scores(games(curves))
    beside, published = scores[scores.agent_steps == 0], scores[scores.agent_steps > 0]
    beside = {source: rows.set_index("game") for source, rows in beside.groupby("source", sort=False)}
    table = []
    for game in games(curves):
        row = [game, last_step(curves, game)]
        for variant in variants(curves):
            if len(final := last_scores(of_seeds := seeds(curves, variant, game))):
                fewest = min(curve.games_ended.iloc[-1] for curve in of_seeds.values())
                of_games = f", {fewest} games" if fewest < 100 else ""
                row.append(f"{over_seeds(final)} (n = {len(final)}{of_games})")
            else:
                row.append("–")
        for lines in beside.values():
            row.append(plus_minus(*lines.loc[game, ["score_mean", "score_std"]]) if game in lines.index else "–")
        table.append(row)
    text = (
        "Mean score of the last 100 games at the agent step given (on Atari 4 frames each): mean ± sample standard"
        " deviation (ddof 1) over n seeds."
    )
    if any(cell.endswith("games)") for row in table for cell in row):
        text += (
            " If a seed had ended fewer than 100 games, the fewest are given, and its mean is over all since the start,"
            " without the long ones that had not ended."
        )
    text = markdown(["game", "agent steps", *variants(curves), *beside], table) + f"\n{text}\n"
    others = [
        [row.game, row.source, f"{row.agent_steps:,}", plus_minus(row.score_mean, row.score_std), row.note]
        for row in published.sort_values("game", kind="stable").itertuples()
    ]
    if others:
        text += "\n" + markdown(["game", "published", "agent steps", "score", "note"], others)
        text += "\nPublished scores, each after the agent steps of its row; they are no measure for another length.\n"
    return text


def evaluation_table(runs: pd.DataFrame) -> str:
    """What the finished agents scored when they played without learning, nothing if none has."""
    table = [
        [run.game, run.variant, str(run.seed), plus_minus(run.eval_mean, run.eval_std), f"{run.eval_games:.0f}"]
        for run in runs[runs.eval_games.notna()].itertuples()
    ]
    text = "\nWhole games that the last agents played without learning: mean ± sample standard deviation (ddof 1).\n"
    return markdown(["game", "variant", "seed", "score", "games"], table) + text if table else ""


def mean_and_interval(strata: list[np.ndarray], number=lambda value: f"{value:.3f}") -> tuple[str, str]:
    interval = bootstrap_interval(strata)
    text = "no interval: one seed" if interval is None else " to ".join(map(number, interval))
    return number(interquartile_mean(np.concatenate(strata))), text


def human_table(stage: Stage) -> str:
    """Interquartile means of human-normalised final scores, nothing if no game has a human score."""
    curves = stage.compared
    ranges = human_ranges(games(curves))
    strata = {}
    for variant in variants(curves):
        finals = [(last_scores(seeds(curves, variant, game)) - low) / height for game, (low, height) in ranges.items()]
        strata[variant] = [final for final in finals if len(final)]
    differences = in_human_ranges(find_margins(stage)["score"]).values()
    strata[f"{stage.challenger} − {stage.baseline}, by pairs"] = [values for values in differences if len(values)]
    table = []
    for name, finals in strata.items():
        if finals:
            counts = ", ".join(str(n) for n in sorted(set(map(len, finals))))
            table.append([name, str(len(finals)), counts, *mean_and_interval(finals)])
    if not table:
        return ""
    return markdown(["", "games", "seeds", "interquartile mean", "95 % interval"], table) + (
        "\nFinal scores as above, (score − random) / (human − random), over games × seeds; the interval draws seeds"
        "\nwithin each game. Pairs have game and seed in common.\n"
    )


def kl_table(stage: Stage) -> str:
    """How far an update moves the policy, over all iterations of all seeds."""
    table, curves = [], stage.compared
    for game, variant in itertools.product(games(curves), variants(curves)):
        if not (of_seeds := list(seeds(curves, variant, game).values())):
            continue
        together = pd.concat(of_seeds)
        numbers = (together.kl.mean(), together.kl.median(), together.kl.quantile(0.99), together.kl.max())
        shares = (
            share_above(together.kl, spike_limit(stage, game)),
            np.mean([share_of_own_spikes(curve.kl) for curve in of_seeds]),
            share_above(together.max_tv_distance, epsilons(stage.runs).get(variant, math.nan) / 2),
        )
        row = [game, variant, str(len(of_seeds)), last_step(curves, game)]
        row += [f"{number:.3g}" for number in numbers]
        row += [f"{share:.2%}" if math.isfinite(share) else "–" for share in shares]
        table.append([*row, f"{together.avg_clip_ratio.mean():.4f}"])
    columns = ["game", "variant", "seeds", "agent steps", "mean KL", "median", "99th percentile", "maximum"]
    columns += [f"spikes: above {stage.baseline}'s 99th percentile", "spikes: above 10 × own median"]
    columns += ["largest TV distance above ε / 2", "average clip ratio"]
    return markdown(columns, table)


def claims_table(stage: Stage) -> str:
    """A line for each claim of the thesis, judged by the rule in this file's docstring."""
    table, words = [], stage.words()
    for claim, margins in find_margins(stage).items():
        said, number, sentence = CLAIMS[claim]
        strata = list((in_human_ranges(margins) if claim == "score" else margins).values())
        if claim == "score" and not stage.final:
            cells = [TOO_EARLY] * (len(margins) + 1)
        else:
            cells = [*map(judge, margins.values()), "–"]
            if len(strata) > 1 and any(map(len, strata)):
                judged = verdict(min(map(len, strata)), *(bootstrap_interval(strata) or (-math.inf, math.inf)))
                mean, interval = mean_and_interval(strata, number)
                cells[-1] = f"{SIGNS[judged]} {judged}: {sentence.format(mean, **words)} ({interval})"
        table.append([said.format(**words), *cells])
    return markdown(["claim", *games(stage.compared), "across games"], table)


def progress_table(stage: Stage, parts: int = 10) -> str:
    """Each run's score at the end of each tenth of its schedule, and its mean KL in that tenth, as far as it got."""
    table, totals = [], total_timesteps(stage.runs)
    for (variant, game, seed), curve in stage.compared.items():
        batch_size = curve.index[0]
        rollouts = totals[variant, game, seed] // batch_size
        ends = [rollouts * i // parts * batch_size for i in range(parts + 1)]
        tenths = [
            curve.loc[start + 1 : end if curve.index[-1] >= end else start] for start, end in itertools.pairwise(ends)
        ]
        scores, kls = [tenth.mean_return_100.tail(1).mean() for tenth in tenths], [tenth.kl.mean() for tenth in tenths]
        for name, numbers, form in (("score", scores, ",.0f"), ("KL", kls, ".2g")):
            cells = [f"{number:{form}}" if math.isfinite(number) else "–" for number in numbers]
            table.append([f"{game} {variant} {seed}", name, *cells])
    return markdown(["run", "of the schedule", *(f"{100 * (i + 1) // parts} %" for i in range(parts))], table)


def spikes_table(curves: Curves, most: int = 10) -> str:
    """The largest KLs of each run, and the other curves at those iterations."""
    columns = "kl times learning_rate entropy explained_variance clipfrac max_tv_distance max_ratio_advantage games"
    headings = "KL, × median, learning rate, entropy, explained variance, clip fraction, largest TV distance"
    headings += ", largest abs((ρ − 1)Â), games ended"
    table = []
    for (variant, game, seed), curve in curves.items():
        curve = curve.assign(times=curve.kl / curve.kl.median(), games=curve.games_ended.diff())[columns.split()]
        largest = curve.nlargest(most, "kl")
        lines = {f"{step:,}": row for step, row in largest.iterrows()}
        lines |= {"their rank": curve.rank(pct=True).loc[largest.index].median(), "all: median": curve.median()}
        for name, row in lines.items():
            cells = [f"{number:.3g}" if math.isfinite(number) else "–" for number in row]
            table.append([f"{game} {variant} {seed}", name, *cells])
    return markdown(["run", "agent step", *headings.split(", ")], table) + (
        f"\nThe {most} largest `losses/kl` of each run, and its other curves at the same iterations. `their rank`: the"
        "\nshare of the run's iterations that are not above them, median; `all: median`: of all iterations.\n"
    )


def short_table(stages: list[Stage]) -> str:
    """The project README's table: of each game, the pairs of its most advanced stage."""
    table = []
    for game in sorted(set().union(*(games(stage.compared) for stage in stages))):
        stage = next((stage for stage in stages if pairs(stage, game)), None)
        if stage is None:
            continue
        both, margins = pairs(stage, game), find_margins(stage)
        finals = [last_scores(dict(enumerate(of_variant))) for of_variant in zip(*both)]
        row = [game, str(len(both)), last_step(stage.compared, game)]
        row += [over_seeds(final) if len(final) else "–" for final in finals]
        row.append(f"{math.exp(margins['KL'][game].mean()):.2f}")
        judged = judge(margins["score"][game]).replace(SIGNS[UNDECIDED], "undecided:") + " pairs"
        table.append([*row, judged if stage.final else TOO_EARLY])
    base, new = stages[0].words()["base"], stages[0].words()["new"]
    return markdown(["game", "n", "steps", base, new, f"{base}'s KL ÷ {new}'s", f"{new} scores more"], table)
