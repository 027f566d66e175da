"""Whether the thesis's claims hold in a set of runs: the rule and its statistics.

Two stages are compared separately. `finished`: of each game, the runs that have done 90 % of their schedule, up to the
last step that all of these have reached. `unfinished`: of each game that has an unfinished run, all runs that are at
least half as long as its longest unfinished one, up to the last step that all of these have reached; of a finished run
these are the first steps.

How a claim is judged. The thesis's baseline is `ppo`, its challenger `acppo`; other variants can stand in their places.
A pair is a run of each with the same game and seed. Each pair has a margin for each claim, above 0 if it has the
claim's sign:
    score            final `mean_return_100`, challenger - baseline (across games in units of human minus random score)
    KL               log of the ratio of the means of `losses/kl`, baseline / challenger
    relative spikes  share of iterations with a KL above the 99th percentile of the baseline's in the same game (all its
                     seeds), baseline - challenger
    own spikes       share of iterations with a KL above ten times the run's own median, baseline - challenger
    clip ratio       0.02 - |difference of the means of `losses/avg_clip_ratio`|, so above 0 if the challenger's is
                     near the baseline's; not for a variant whose ranges do not clip
Over all pairs of all games, a claim is judged by Wilcoxon's signed-rank test of their margins: exact, that is over all
2ⁿ assignments of signs, and two-sided. Equal sizes share their mean rank; a margin of 0 keeps its rank and counts for
neither sign. A claim holds, or does not hold, at p ≤ 0.05; else the two cannot be told apart with these runs. With
fewer than six pairs that differ that is always so: p is at least 2 of 2ⁿ. Games without a human score are left out of
the final scores' test. Each claim is judged by itself, and of the spikes above the baseline's percentile p says little,
because that limit is fitted to the baseline. On one game a claim holds if every margin is above 0, and does not hold if
every margin is below 0. With fewer than three pairs on the game the two cannot be told apart there: of two equal
algorithms two pairs agree every second time, three still every fourth. Three pairs can never be below p = 0.25, so this
is the weaker verdict. For unfinished runs it is too early to judge a final score. A KL below 1e-8 is a 0 with the
rounding errors of float32, and counts as 1e-8.

This rule was committed eight minutes into the first two of the runs (8073f69), before any had ended. Added since: that
all runs of a game are cut at one step, not each pair at its own (when the seeds had come to different lengths); the
stages, and that final scores wait for 90 % of the schedule (when one pair had finished, in which ppo scores more). On
2026-11-28, while 2 of the 15 pairs were finished (ppo scores more in both) and before the next had ended: the exact
test took the place of the 95 % bootstrap interval of the interquartile mean, which excluded 0 for two equal algorithms
one time in ten; six pairs in all took the place of three on every game; the clip ratio is held against the baseline's
mean, pair by pair, no longer against its ε, and left out for variants that do not clip; the least KL is 1e-8.

The size of an effect is the interquartile mean of all margins, which the test does not use. A plain mean is never used:
the human score of DoubleDunk is 2.2 points above random.
"""

import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from benchmark.collect import Curves, Runs

FINISHED = 0.9  # of its schedule
FEWEST_PAIRS_OF_A_GAME, FEWEST_PAIRS = 3, 6
SCORES = pd.read_csv(Path(__file__).with_name("scores.csv"), encoding="utf-8").fillna({"note": ""})  # published ones
# Game → scores of human and random play, which have no agent steps
PLAYED = SCORES[SCORES.agent_steps.isna()].pivot(index="game", columns="source", values="score_mean")
# Of the Atari-5 score (Aitchison et al. 2022, github.com/maitchison/Atari-5): game → weight, random and human score
ATARI_5 = pd.read_csv(Path(__file__).with_name("atari5.csv"), index_col="game", encoding="utf-8")
HOLDS, FAILS, UNDECIDED = "holds", "does not hold", "cannot be told apart with these runs"
TOO_FEW = "too few pairs"  # to tell the two apart, whatever their margins
LEAST_KL = 1e-8
LEVEL = 0.05  # of p
VARIANT_ORDER = ("ppo", "acppo", "ppo-matched", "ppo-wide", "product")  # the thesis's two first; others by name


@dataclass
class Stage:
    name: str  # finished or unfinished
    baseline: str
    epsilons: dict[str, float]  # variant → its widest clip range, of those whose ranges clip and have a bound
    runs: Runs = field(default_factory=dict)
    drawn: Curves = field(default_factory=dict)  # as far as the figures show them
    compared: Curves = field(default_factory=dict)  # as the tables and claims compare them


def make_stages(runs: Runs, curves: Curves, baseline: str = "ppo", unclipped: tuple[str, ...] = ()) -> list[Stage]:
    """Returns the stages that have runs, the finished one first; runs are sorted by game, variant and seed.

    Variants in `unclipped` have no ε and no clip ratio.
    """
    curves = {key: curve.assign(kl=curve.kl.clip(lower=LEAST_KL)) for key, curve in curves.items()}
    clipped = {key: run for key, run in runs.items() if key[0] not in unclipped}
    curves |= {key: curves[key].assign(avg_clip_ratio=math.nan) for key in runs.keys() - clipped.keys()}
    stages = [Stage(name, baseline, find_epsilons(clipped)) for name in ("finished", "unfinished")]
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


def pairs(stage: Stage, challenger: str, game: str) -> list[tuple[pd.DataFrame, pd.DataFrame]]:
    """Returns the curves of baseline and challenger, seed by seed."""
    base, new = (seeds(stage.compared, variant, game) for variant in (stage.baseline, challenger))
    return [(base[seed], new[seed]) for seed in sorted(base.keys() & new.keys())]


def find_epsilons(runs: Runs) -> dict[str, float]:
    """Returns each variant's ε, its widest clip range, if it has one; with c = inf the range has no bound."""
    bounded = {key[0]: run["arguments"] for key, run in runs.items() if str(run["arguments"].get("c")) != "inf"}
    return {name: args["clip_coef"] for name, args in bounded.items() if "clip_coef" in args}


def interquartile_mean(values: np.ndarray) -> float:
    """(n,) → the mean of the middle half; of a value on its border, the part inside (scipy takes all)."""
    borders = np.linspace(0, 1, len(values) + 1)  # value i of the sorted ones covers borders[i] to borders[i + 1]
    return float(np.sort(values) @ (2 * np.diff(borders.clip(0.25, 0.75))))


def signed_rank_test(margins: np.ndarray) -> tuple[float, float]:
    """Returns the sum of signed ranks of margins (n,), doubled, and its exact two-sided p."""
    sizes = np.abs(margins)
    ranks = [2 * (sizes < size).sum() + (sizes == size).sum() + 1 for size in sizes]  # doubled, so whole numbers
    shares = np.ones(1)  # of the assignments of signs, by the sum of the positive ranks
    for rank in itertools.compress(ranks, margins):
        shares = (np.pad(shares, (rank, 0)) + np.pad(shares, (0, rank))) / 2
    total = np.sign(margins) @ np.array(ranks, dtype=float)
    totals = 2 * np.arange(len(shares)) - (len(shares) - 1)
    return total, float(shares[np.abs(totals) >= abs(total)].sum())


def atari5_score(scores: pd.Series) -> float:
    """Returns an estimate, by the scores of its five games, of the median over 57 games in % of human play."""
    percent = 100 * (scores - ATARI_5.random) / (ATARI_5.human - ATARI_5.random)
    return float(10 ** (ATARI_5.weight * np.log10(1 + percent.clip(lower=0))).sum(skipna=False) - 1)


def spike_limit(stage: Stage, game: str) -> float:
    """Returns the 99th percentile of the KL of all of the baseline's runs, NaN if there are none."""
    kl = [curve.kl for curve in seeds(stage.compared, stage.baseline, game).values()]
    return float(np.quantile(pd.concat(kl), 0.99)) if kl else math.nan


def share_above(values: pd.Series, limit: float) -> float:
    return float((values > limit).mean()) if math.isfinite(limit) else math.nan


def share_of_own_spikes(kl: pd.Series) -> float:
    return share_above(kl, 10 * kl.median())


def find_margins(stage: Stage, challenger: str) -> dict[str, dict[str, np.ndarray]]:
    """Returns claim → game → (pairs,) by the rule that opens this file, without pairs that lack the measure."""
    margins: dict[str, dict[str, np.ndarray]] = {}
    for game in games(stage.compared):
        both, limit = pairs(stage, challenger, game), spike_limit(stage, game)
        of_game = {
            "score": [new.mean_return_100.iloc[-1] - base.mean_return_100.iloc[-1] for base, new in both],
            "KL": [np.log(base.kl.mean()) - np.log(new.kl.mean()) for base, new in both],
            "relative spikes": [share_above(base.kl, limit) - share_above(new.kl, limit) for base, new in both],
            "own spikes": [share_of_own_spikes(base.kl) - share_of_own_spikes(new.kl) for base, new in both],
            "clip ratio": [0.02 - abs(new.avg_clip_ratio.mean() - base.avg_clip_ratio.mean()) for base, new in both],
        }
        for claim, values in of_game.items():
            known = [round(value, 12) for value in values if math.isfinite(value)]  # so that equal shares are equal
            margins.setdefault(claim, {})[game] = np.array(known)
    return {claim: of_games for claim, of_games in margins.items() if any(map(len, of_games.values()))}


def pool(claim: str, margins: dict[str, np.ndarray]) -> np.ndarray:
    """Returns all games' margins; scores of several games in units of human minus random score, where that is known."""
    margins = {game: of_game for game, of_game in margins.items() if len(of_game)}
    comparable = claim != "score" or len(margins) < 2
    units = dict.fromkeys(margins, 1) if comparable else (PLAYED.human - PLAYED.random).to_dict()
    return np.concatenate([np.zeros(0), *(margins[game] / units[game] for game in margins if game in units)])


def judge_game(margins: np.ndarray) -> str:
    if len(margins) < FEWEST_PAIRS_OF_A_GAME:
        return TOO_FEW
    return UNDECIDED if min(margins) <= 0 <= max(margins) else HOLDS if min(margins) > 0 else FAILS


def judge(margins: np.ndarray) -> str:
    """Judges the margins of all games' pairs."""
    total, p = signed_rank_test(margins)
    if p > LEVEL:
        return TOO_FEW if len(margins) < FEWEST_PAIRS else UNDECIDED
    return HOLDS if total > 0 else FAILS


def find_change(margins: np.ndarray) -> str:
    """Says how few further pairs, larger than all others, could change what `judge` says."""
    decided, largest = signed_rank_test(margins)[1] <= LEVEL, np.abs(margins).max(initial=0)
    for count in itertools.count(1):
        more = largest + np.arange(1, count + 1)
        p = {side: signed_rank_test(np.append(margins, sign * more))[1] for side, sign in (("for", 1), ("against", -1))}
        if changed := [f"all {side} it" for side in p if (p[side] <= LEVEL) != decided]:
            return f"{count} or more further pairs, {' or '.join(changed)}"
