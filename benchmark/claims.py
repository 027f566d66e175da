"""Whether the thesis's claims hold in a set of runs: the rule and its statistics.

Two stages are compared separately. `finished`: of each game, the runs that have done 90 % of their schedule, up to the
last step that all of these have reached. `unfinished`: of each game that has an unfinished run, all runs that are at
least half as long as its longest unfinished one, up to the last step that all of these have reached; of a finished run
these are the first steps.

How a claim is judged. The thesis's baseline is `ppo`, its challenger `acppo`; two other variants can stand in their
places. A pair is a run of each with the same game and seed. Each pair has a margin for each claim, above 0 if it has
the claim's sign:
    score            final `mean_return_100`, challenger - baseline (across games in units of human minus random score)
    KL               log of the ratio of the means of `losses/kl`, baseline / challenger
    relative spikes  share of iterations with a KL above the 99th percentile of the baseline's in the same game (all its
                     seeds), baseline - challenger
    own spikes       share of iterations with a KL above ten times the run's own median, baseline - challenger
    clip ratio       0.02 - |mean of `losses/avg_clip_ratio` - the baseline's ε|, so for PPO's 0.1 above 0 from 0.08 to
                     0.12; only of the challenger's runs
On one game a claim holds if every margin is above 0, and does not hold if every margin is below 0; else the two cannot
be told apart with these runs. Across games the same is asked of both ends of the 95 % interval of the interquartile
mean of all margins. With fewer than three pairs, on the game or on any of the games, the two cannot be told apart at
all: of two equal algorithms two pairs agree every second time, three still every fourth. For unfinished runs it is too
early to judge a final score.

This rule was committed eight minutes into the first two of the runs (8073f69), before any had ended. Added since: that
all runs of a game are cut at one step, not each pair at its own (when the seeds had come to different lengths); the
stages, and that final scores wait for 90 % of the schedule (when one pair had finished, in which ppo scores more).

The interval is the percentile bootstrap that draws seeds with replacement within each game. From three seeds it is too
narrow: of two equal algorithms, three normal pairs on each of five games, it excludes 0 one time in ten, not in twenty
(tests/test_results.py counts). A plain mean is never used: the human score of DoubleDunk is 2.2 points above random.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from benchmark.collect import Curves, Runs

FINISHED = 0.9  # of its schedule
FEWEST_PAIRS = 3
SCORES = pd.read_csv(Path(__file__).parent / "scores.csv", encoding="utf-8").fillna({"note": ""})  # published ones
# Game → scores of human and random play, which have no agent steps, and their difference
PLAYED = SCORES[SCORES.agent_steps.isna()].pivot(index="game", columns="source", values="score_mean")
PLAYED = PLAYED.assign(range=PLAYED.human - PLAYED.random)
UNDECIDED = "cannot be told apart with these runs"
DRAWS = 10_000  # of the bootstrap
VARIANT_ORDER = ("ppo", "acppo", "ppo-matched", "ppo-wide", "product")  # the thesis's two first; others by name


@dataclass
class Stage:
    name: str  # finished or unfinished
    baseline: str
    challenger: str
    epsilon: float  # the baseline's, NaN if it has none
    runs: Runs = field(default_factory=dict)
    drawn: Curves = field(default_factory=dict)  # as far as the figures show them
    compared: Curves = field(default_factory=dict)  # as the tables and claims compare them


def make_stages(runs: Runs, curves: Curves, baseline: str = "ppo", challenger: str = "acppo") -> list[Stage]:
    """Returns the stages that have runs, the finished one first; runs are sorted by game, variant and seed."""
    epsilon = epsilons(runs).get(baseline, math.nan)
    stages = [Stage(name, baseline, challenger, epsilon) for name in ("finished", "unfinished")]
    for game in games(curves):
        keys = [(name, game, seed) for name in variants(curves) for seed in sorted(seeds(curves, name, game))]
        ends = {key: curves[key].index[-1] for key in keys}
        finished = {key: curves[key] for key in keys if ends[key] >= FINISHED * runs[key]["total_timesteps"]}
        longest = max((ends[key] for key in keys if key not in finished), default=0)
        first_steps = {key: curves[key].loc[:longest] for key in keys if longest}
        long_enough = {key: curve for key, curve in first_steps.items() if ends[key] >= longest / 2}
        for stage, drawn, compared in zip(stages, (finished, first_steps), (finished, long_enough)):
            end = min((curve.index[-1] for curve in compared.values()), default=0)
            stage.runs |= {key: runs[key] for key in drawn}
            stage.drawn |= drawn
            stage.compared |= {key: curve.loc[:end] for key, curve in compared.items()}
    return [stage for stage in stages if stage.runs]


def variants(curves: Curves) -> list[str]:
    return sorted({variant for variant, _, _ in curves}, key=lambda name: ((*VARIANT_ORDER, name).index(name), name))


def games(curves: Curves) -> list[str]:
    return sorted({game for _, game, _ in curves})


def seeds(curves: Curves, variant: str, game: str) -> dict[int, pd.DataFrame]:
    return {key[2]: curve for key, curve in curves.items() if key[:2] == (variant, game)}


def pairs(stage: Stage, game: str) -> list[tuple[pd.DataFrame, pd.DataFrame]]:
    """Returns the curves of baseline and challenger, seed by seed."""
    base, new = (seeds(stage.compared, variant, game) for variant in (stage.baseline, stage.challenger))
    return [(base[seed], new[seed]) for seed in sorted(base.keys() & new.keys())]


def epsilons(runs: Runs) -> dict[str, float]:
    """Returns each variant's ε, its widest clip range, if it has one; with c = inf the range has no bound."""
    bounded = {key[0]: run["arguments"] for key, run in runs.items() if str(run["arguments"].get("c")) != "inf"}
    return {name: args["clip_coef"] for name, args in bounded.items() if "clip_coef" in args}


def interquartile_mean(values: np.ndarray) -> np.ndarray:
    """(..., n) → (...): the mean of the middle half; of a value on its border, the part inside (scipy takes all)."""
    borders = np.linspace(0, 1, values.shape[-1] + 1)  # value i of the sorted ones covers borders[i] to borders[i + 1]
    weights = 2 * np.diff(borders.clip(0.25, 0.75))
    return np.sort(values, axis=-1) @ weights


def bootstrap_interval(strata: list[np.ndarray]) -> tuple[float, float] | None:
    """Returns the 95 % interval of the interquartile mean of games' values (seeds,), seeds redrawn within a game."""
    if min(map(len, strata)) < 2:
        return None  # drawing from one seed gives itself, an interval without the width that seeds have
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
    margins: dict[str, dict[str, np.ndarray]] = {}
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
            margins.setdefault(claim, {})[game] = np.array([value for value in values if math.isfinite(value)])
    return margins


def in_human_ranges(margins: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Returns differences of scores in units of human minus random score, of the games that have these."""
    return {game: values / PLAYED.range[game] for game, values in margins.items() if game in PLAYED.index}


def judge(fewest_pairs: int, margins: Sequence[float] | None) -> str:
    """Judges the margins of a game's pairs, or across games both ends of the interval."""
    if fewest_pairs < FEWEST_PAIRS or min(margins) <= 0 <= max(margins):
        return UNDECIDED
    return "holds" if min(margins) > 0 else "does not hold"
