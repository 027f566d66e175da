"""The results page of a set of runs: tables, figures, and the verdicts on the thesis's claims.

    python benchmark/report.py
    python benchmark/report.py --out ../another-grid --baseline ppo --challenger mine another
    python benchmark/report.py --note spo --challenger spo

`collect.py` brings OUT/runs up to date with OUT/training; all else is made from OUT/runs. Runs without a note are
compared in OUT/README.md, those with a note in OUT/NOTE.md. A page opens with the verdicts, from `<!-- verdicts -->` to
`<!-- end verdicts -->`; the tables are between two such marks for `results`; what stands elsewhere stays. The figures
are OUT/figures/[NOTE-]STAGE/*.png. The default set's short table goes into the project's README. `claims.py` says what
a stage is and how a claim is judged.
"""

import itertools
import math
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark import claims, collect
from benchmark.claims import FAILS, HOLDS, TOO_FEW, UNDECIDED, Stage, games, pairs, seeds, share_above, variants
from benchmark.collect import DEFAULT_OUT, ROOT, Curves, Runs
from benchmark.figures import FIGURES, draw
from benchmark.readme import markdown, write_parts
from bookkeeping import usage_error

DISPLAY_NAMES = {"ppo": "PPO", "acppo": "AC-PPO"}  # the others' names are as they were given
SIGNS = {HOLDS: "✓", FAILS: "✗", UNDECIDED: "?", TOO_FEW: "?"}
TOO_EARLY = "too early"
# Claim → its sentence; the format of a margin over all pairs, and its unit
CLAIM_TEXTS = {
    "score": ("{new}'s final score is above {base}'s", "+.3g", "{} of human minus random score"),
    "KL": ("{new}'s KL between policy updates is smaller", ".2f", "{base}'s mean KL is {} times {new}'s"),
    "relative spikes": ("{new} has fewer KL spikes above the 99th percentile of {base}'s", "+.2%", "{} of iterations"),
    "own spikes": ("{new} has fewer KL spikes above ten times the run's own median", "+.2%", "{} of iterations"),
    "clip ratio": ("{new}'s average clip ratio is within 0.02 of {base}'s", ".4f", "the means are {} apart"),
}
LEGEND = """✓ holds, ✗ does not hold, ? cannot be told apart with these runs. Too few pairs are fewer than six that \
differ (p is at least 2 of 2ⁿ); of one game, fewer than three (even three agree by chance every fourth time, p = 0.25).
"""


@dataclass
class Args(collect.Args):
    baseline: str = "ppo"
    """variant that the others are compared with, by its seeds and its KL's 99th percentile"""
    challenger: tuple[str, ...] = ("acppo",)
    """variants that the verdicts are on"""
    unclipped: tuple[str, ...] = ("spo",)
    """variants whose ranges do not clip, so that they have no clip ratio to compare"""


def cell(number: float, form: str) -> str:
    return format(number, form) if math.isfinite(number) else "–"


def score(mean: float, std: float | None = None) -> str:
    """Returns a score with a decimal, or as many as give the larger of the two three digits."""
    if not math.isfinite(mean):
        return "–"
    size = max(abs(mean), 0 if pd.isna(std) else std)
    decimals = max(1, 2 - math.floor(math.log10(size))) if size else 1
    return f"{mean:,.{decimals}f}" + ("" if pd.isna(std) else f" ± {std:,.{decimals}f}")


def last_scores(curves: list[pd.DataFrame]) -> pd.Series:
    """Returns the last `mean_return_100` of each run that has ended a game."""
    return pd.Series([curve.mean_return_100.iloc[-1] for curve in curves], dtype=float).dropna()


def last_step(curves: Curves, game: str) -> str:
    return f"{next(curve for key, curve in curves.items() if key[1] == game).index[-1]:,}"


def titled(title: str, columns: list[str], rows: list[list[str]]) -> str:
    return f"{title}:\n\n{markdown(columns, rows)}" if rows else ""


def score_table(curves: Curves) -> str:
    rows = []
    for game in games(curves):
        row = [game, last_step(curves, game)]
        for runs in (seeds(curves, variant, game).values() for variant in variants(curves)):
            final, fewest = last_scores(runs), min((curve.games_ended.iloc[-1] for curve in runs), default=100)
            counts = f" (n = {len(final)}" + (f", {fewest} games)" if fewest < 100 else ")")
            row.append(score(final.mean(), final.std()) + (counts if len(final) else ""))
        rows.append([*row, *(score(claims.PLAYED[who].get(game, math.nan)) for who in ("random", "human"))])
    title = "Mean of the last 100 games (of all, where a seed has ended fewer), ± sample deviation over n seeds"
    return titled(title, ["game", "agent steps", *variants(curves), "random", "human"], rows)


def published_table(curves: Curves) -> str:
    scores = claims.SCORES[claims.SCORES.game.isin(games(curves)) & (claims.SCORES.agent_steps > 0)]
    rows = [
        [row.game, row.source, f"{row.agent_steps:,.0f}", score(row.score_mean, row.score_std), row.note]
        for row in scores.sort_values("game", kind="stable").itertuples()
    ]
    title = "Published scores, each after the steps of its row; they are no measure for another length"
    return titled(title, ["game", "published", "agent steps", "score", "note"], rows)


def atari5_table(curves: Curves) -> str:
    rows = []
    for variant, seed in dict.fromkeys((name, seed) for name, game, seed in curves if game in claims.ATARI_5.index):
        of_seed = {game: curve for (name, game, number), curve in curves.items() if (name, number) == (variant, seed)}
        missing = ", ".join(game for game in claims.ATARI_5.index if game not in of_seed)
        scores = pd.Series({game: curve.mean_return_100.iloc[-1] for game, curve in of_seed.items()})
        value = claims.atari5_score(scores.reindex(claims.ATARI_5.index))
        rows.append([variant, str(seed), f"needs {missing}" if missing else cell(value, ".1f")])
    title = "Atari-5 score, an estimate of the median over 57 games in % of human play. It was fitted on agents above "
    title += "40 %, with an error of about 10 % of it"
    return titled(title, ["variant", "seed", "score"], rows)


def run_table(runs: Runs, curves: Curves) -> str:
    rows = []
    for key, run in runs.items():
        played, curve, arithmetic = run["evaluation"], curves[key], ["bf16"] * bool(run["arguments"].get("bf16"))
        machines = dict.fromkeys(machine.partition(", ")[2] or machine for machine in run["machine"].split("; "))
        row = [key[1], key[0], str(key[2]), f"{run['steps']:,}", score(curve.mean_return_100.iloc[-1])]
        row += [f"{score(played['mean'], played['std'])} (n = {played['games']})" if played else "–"]
        row += [cell(curve.kl.clip(lower=claims.LEAST_KL).mean(), ".3g"), ", ".join(["; ".join(machines), *arithmetic])]
        row += [f"{run['hours']:.1f}" if run["hours"] else "–"]
        rows.append([*row, re.sub(r"\b([0-9a-f]{7})[0-9a-f]{33}", r"\1", run["commit"])])
    hours = [run["hours"] for run in runs.values() if run["hours"]]
    known = f"; hours are known of {len(hours)} of {len(runs)}, together {sum(hours):.1f}" if hours else ""
    title = f"What each run came to and cost{known}"
    columns = ["game", "variant", "seed", "agent steps", "final score", "without learning", "mean KL", "machine"]
    return titled(title, [*columns, "hours", "commit"], rows)


def kl_table(stage: Stage) -> str:
    rows, curves = [], stage.compared
    for game, variant in itertools.product(games(curves), variants(curves)):
        if runs := list(seeds(curves, variant, game).values()):
            together = pd.concat(runs)
            kl = together.kl
            relative = share_above(kl, claims.spike_limit(stage, game))
            own = np.mean([claims.share_of_own_spikes(curve.kl) for curve in runs])
            far = share_above(together.max_tv_distance, stage.epsilons.get(variant, math.nan) / 2)
            row = [game, variant, str(len(runs)), last_step(curves, game)]
            row += [f"{number:.3g}" for number in (kl.mean(), kl.median(), kl.quantile(0.99), kl.max())]
            row += [cell(share, ".2%") for share in (relative, own, far)]
            rows.append([*row, cell(together.avg_clip_ratio.mean(), ".4f")])
    columns = ["game", "variant", "seeds", "agent steps", "mean KL", "median", "99th percentile", "maximum"]
    columns += [f"spikes: above {stage.baseline}'s 99th percentile", "spikes: above 10 × own median"]
    columns += ["largest TV distance above ε / 2", "average clip ratio"]
    return titled("`losses/kl` (nats) over all iterations up to this step, and shares of them", columns, rows)


def names(stage: Stage, challenger: str) -> dict[str, str]:
    """Returns what the texts call the two variants."""
    return {key: DISPLAY_NAMES.get(name, name) for key, name in (("base", stage.baseline), ("new", challenger))}


def count(margins: np.ndarray) -> str:
    """Returns how many of the margins have the claim's sign."""
    ties = f", {(margins == 0).sum()} equal" if (margins == 0).any() else ""
    return f"{(margins > 0).sum()} of {len(margins)}{ties}"


def game_verdict(margins: np.ndarray) -> str:
    judged = claims.judge_game(margins)
    return f"{TOO_FEW} ({count(margins)})" if judged == TOO_FEW else f"{SIGNS[judged]} {count(margins)}"


def claims_tables(stage: Stage, challenger: str) -> tuple[str, str]:
    """Returns the table of verdicts over all pairs, and that of verdicts on each game."""
    rows, of_games, called = [], [], names(stage, challenger)
    for claim, margins in claims.find_margins(stage, challenger).items():
        (sentence, form, unit), values = CLAIM_TEXTS[claim], claims.pool(claim, margins)
        sentence, judged, size = sentence.format(**called), claims.judge(values), claims.interquartile_mean(values)
        # A KL's margin is the log of a ratio, a clip ratio's is what the distance leaves of 0.02
        number = format(math.exp(size) if claim == "KL" else 0.02 - size if claim == "clip ratio" else size, form)
        in_points = claim == "score" and sum(len(of_game) > 0 for of_game in margins.values()) == 1
        effect = f"{score(size)} points" if in_points else unit.format(number, **called)
        pairs_for = f"{count(values)}, p = {claims.signed_rank_test(values)[1]:.2g}"
        cells = [f"{SIGNS[judged]} {judged}", effect, pairs_for, claims.find_change(values)]
        by_game = map(game_verdict, margins.values())
        if claim == "score" and stage.name == "unfinished":
            cells, by_game = [TOO_EARLY, "–", "–", "finished runs"], [TOO_EARLY] * len(margins)
        elif not len(values):
            cells = ["–", "–", "–", "human scores, by which games compare"]
        rows.append([sentence, *cells])
        of_games.append([sentence, *by_game])
    thesis = (stage.baseline, challenger) == ("ppo", "acppo")
    title = "Claims of the thesis" if thesis else "{new} against {base}".format(**called)
    columns = ["claim", "verdict", "effect", "pairs for it, p", "what would change it"]
    none = "No {} run of {new} has game and seed in common with one of {base}.\n".format(stage.name, **called)
    return (
        titled(f"{title}, {stage.name} runs", columns, rows) or none,
        titled(f"{title}, by games", ["claim", *games(stage.compared)], of_games),
    )


def progress_table(stage: Stage) -> str:
    """Nothing unless all have done half of their schedules, so that the course of each says something."""
    rows = []
    for key, curve in stage.compared.items():
        total, batch_size, done = stage.runs[key]["total_timesteps"], curve.index[0], curve.index[-1]
        if done < total / 2:
            return ""
        ends = [total // batch_size * i // 10 * batch_size for i in range(11)]
        tenths = [curve.loc[start + 1 : end if done >= end else start] for start, end in itertools.pairwise(ends)]
        run = f"{key[1]} {key[0]} {key[2]}"
        rows.append([run, "score", *(score(tenth.mean_return_100.tail(1).mean()) for tenth in tenths)])
        rows.append([run, "KL", *(cell(tenth.kl.mean(), ".2g") for tenth in tenths)])
    title = "Score at the end of each tenth of the schedule, and mean KL in it"
    return titled(title, ["run", "", *(f"{percent} %" for percent in range(10, 101, 10))], rows)


def short_table(stages: list[Stage]) -> str:
    """The project README's table: of each game, the pairs of its most advanced stage."""
    rows, (base, new) = {}, names(stages[0], "acppo").values()
    for stage in stages:
        margins = claims.find_margins(stage, "acppo")
        for game in games(stage.compared):
            if game not in rows and (both := pairs(stage, "acppo", game)):
                finals = [score(final.mean(), final.std()) for final in map(last_scores, zip(*both))]
                ratio = f"{math.exp(margins['KL'][game].mean()):.2f}"
                judged = game_verdict(margins["score"][game]) if stage.name == "finished" else TOO_EARLY
                rows[game] = [str(len(both)), last_step(stage.compared, game), *finals, ratio, judged]
    columns = ["game", "n", "steps", base, new, f"{base}'s KL ÷ {new}'s", f"{new} scores more"]
    return markdown(columns, [[game, *rows[game]] for game in sorted(rows)])


def coverage(stage: Stage) -> str:
    """Says how many runs a stage has, how much of their schedule they have done, and where they differ."""
    runs = list(stage.runs.values())
    done = [100 * curve.index[-1] / stage.runs[key]["total_timesteps"] for key, curve in stage.drawn.items()]
    share = " to ".join(dict.fromkeys(f"{percent:.3g} %" for percent in (min(done), max(done))))
    schedules = " or ".join(f"{steps:,}" for steps in sorted({run["total_timesteps"] for run in runs}))
    text = f"{len(runs)} runs, at {share} of a schedule of {schedules} agent steps."
    if stage.name == "unfinished":
        text += " This is so at these steps, and says nothing about the schedule's end."
    if left_out := [f"{key[1]} {key[0]} {key[2]}" for key in stage.drawn if key not in stage.compared]:
        text += f" Only in the figures, being shorter than half of their game's longest: {', '.join(left_out)}."
    scripts = {(key[0], run["versions"].get("script")) for key, run in stage.runs.items()}
    if len(scripts) > len({variant for variant, _ in scripts}):
        text += " Some runs of a variant were trained by different versions of its script."
    return text + "\n"


def page_parts(stages: list[Stage], challengers: tuple[str, ...], prefix: str = "") -> dict[str, str]:
    """Returns what a page opens with, and its tables; `prefix` begins the names of its directories of figures."""
    opening, results = [], []
    for stage in stages:
        files = f"figures/{prefix}{stage.name}"
        score_figure, kl_figure, clip_figure = (f"![{FIGURES[name][0]}]({files}/{name}.png)\n" for name in FIGURES)
        verdicts, of_games = zip(*(claims_tables(stage, challenger) for challenger in challengers))
        results += [f"## {stage.name.capitalize()} runs\n", coverage(stage)]
        if stage is stages[0]:
            opening = [*verdicts, LEGEND, score_figure]
        else:
            results += [*verdicts, score_figure]
        results.append(score_table(stage.compared))
        results += [published_table(stage.compared), atari5_table(stage.compared)] if stage.name == "finished" else []
        results += [kl_figure, kl_table(stage), clip_figure, *of_games, progress_table(stage)]
    return {"verdicts": "\n".join(opening), "results": "\n".join(filter(None, results))}


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    # A run that is new and not named belongs to the set without a note
    collect.collect(args.out, args.training_directories, args.note if args.training_directories else "")
    runs, curves = collect.read_runs(args.out, args.note)
    if not runs:
        usage_error(f"--out {args.out}", f"no run there has {f'the note {args.note}' if args.note else 'no note'}")
    known = {variant for variant, _, _ in runs}
    for variant in {args.baseline, *args.challenger} - known - {"ppo", "acppo"}:  # without these, there are figures
        usage_error(f"variant {variant}", f"no run is of it; give one of {', '.join(sorted(known))}")
    stages, prefix = claims.make_stages(runs, curves, args.baseline, args.unclipped), args.note and f"{args.note}-"
    parts = page_parts(stages, args.challenger, prefix)
    parts["results"] += f"\n## All runs\n\n{run_table(runs, curves)}"
    write_parts(args.out / f"{args.note or 'README'}.md", **parts)
    if args.out.resolve() == DEFAULT_OUT and (args.note, args.baseline) == ("", "ppo"):
        write_parts(ROOT / "README.md", results=short_table(stages))
    for stage in stages:
        draw(stage, args.out / "figures" / f"{prefix}{stage.name}")


if __name__ == "__main__":
    main()
