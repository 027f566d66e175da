"""The results page of a set of runs: tables, figures, and the verdicts on the thesis's claims.

    python benchmark/report.py
    python benchmark/report.py --out ../another-grid --baseline ppo --challenger mine
    python benchmark/report.py --note spo --challenger spo

`collect.py` brings OUT/runs up to date with OUT/training; all else is made from OUT/runs. Runs without a note are
compared in OUT/README.md, those with a note in OUT/NOTE.md; what stands there outside `<!-- results -->` and
`<!-- end results -->` stays. The figures are OUT/figures/[NOTE-]STAGE/*.png. The default set's short table goes between
the same marks of the project's README. `claims.py` says what a stage is and how a claim is judged.
"""

import itertools
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark import claims, collect
from benchmark.claims import UNDECIDED, Stage, games, pairs, seeds, share_above, variants
from benchmark.collect import DEFAULT_OUT, ROOT, Curves, Runs
from benchmark.figures import FIGURES, draw
from benchmark.readme import markdown, write_part
from bookkeeping import usage_error

DISPLAY_NAMES = {"ppo": "PPO", "acppo": "AC-PPO"}  # the others' names are as they were given
SIGNS = {"holds": "✓", "does not hold": "✗", UNDECIDED: "?"}
TOO_EARLY = "too early"
# Claim → its sentence; the format of a margin across games, and its unit
CLAIM_TEXTS = {
    "score": ("{new}'s final score is above {base}'s", "+.3f", "{} of human minus random score"),
    "KL": ("{new}'s KL between policy updates is smaller", ".2f", "{base}'s mean KL is {} times {new}'s"),
    "relative spikes": ("{new} has fewer KL spikes above the 99th percentile of {base}'s", "+.2%", "{} of iterations"),
    "own spikes": ("{new} has fewer KL spikes above ten times the run's own median", "+.2%", "{} of iterations"),
    "clip ratio": ("{new}'s average clip ratio is near {base}'s ε, {near}", "+.4f", "{} inside the band"),
}
LEGEND = "✓ holds, ✗ does not hold, ? cannot be told apart with these runs. More in the project's results/README.md.\n"


@dataclass
class Args(collect.Args):
    baseline: str = "ppo"
    """variant that the other one is compared with, by its seeds, its ε and its KL's 99th percentile"""
    challenger: str = "acppo"
    """variant that the verdicts are on"""


def cell(number: float, form: str) -> str:
    return format(number, form) if math.isfinite(number) else "–"


def plus_minus(mean: float, std: float | None) -> str:
    return cell(mean, ",.1f") + ("" if pd.isna(std) else f" ± {std:,.1f}")


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
            row.append(plus_minus(final.mean(), final.std()) + (counts if len(final) else ""))
        rows.append([*row, *(cell(claims.PLAYED[who].get(game, math.nan), ",.1f") for who in ("random", "human"))])
    title = "Mean of the last 100 games (of all, where a seed has ended fewer): mean ± sample deviation over n seeds"
    return titled(title, ["game", "agent steps", *variants(curves), "random", "human"], rows)


def published_table(curves: Curves) -> str:
    scores = claims.SCORES[claims.SCORES.game.isin(games(curves)) & (claims.SCORES.agent_steps > 0)]
    rows = [
        [row.game, row.source, f"{row.agent_steps:,.0f}", plus_minus(row.score_mean, row.score_std), row.note]
        for row in scores.sort_values("game", kind="stable").itertuples()
    ]
    title = "Published scores, each after the steps of its row; they are no measure for another length"
    return titled(title, ["game", "published", "agent steps", "score", "note"], rows)


def evaluation_table(runs: Runs) -> str:
    rows = [
        [game, variant, str(seed), plus_minus(result["mean"], result["std"]), str(result["games"])]
        for (variant, game, seed), run in runs.items()
        if (result := run["evaluation"])
    ]
    title = "Whole games that the last agents played without learning, mean ± sample standard deviation"
    return titled(title, ["game", "variant", "seed", "score", "games"], rows)


def mean_and_interval(strata: list[np.ndarray], number="{:.3f}".format) -> tuple[str, str]:
    interval = claims.bootstrap_interval(strata)
    text = "no interval: one seed" if interval is None else " to ".join(map(number, interval))
    return number(claims.interquartile_mean(np.concatenate(strata))), text


def human_table(stage: Stage) -> str:
    curves, differences, rows = stage.compared, {}, []
    for name in variants(curves):
        scores = {game: last_scores(seeds(curves, name, game).values()) for game in games(curves)}
        differences[name] = {game: of - claims.PLAYED.random.get(game, math.nan) for game, of in scores.items()}
    differences[f"{stage.challenger} − {stage.baseline}, by pairs"] = claims.find_margins(stage)["score"]
    for name, of_games in differences.items():
        if strata := [of_game for of_game in claims.in_human_ranges(of_games).values() if len(of_game)]:
            counts = ", ".join(map(str, sorted(set(map(len, strata)))))
            rows.append([name, str(len(strata)), counts, *mean_and_interval(strata)])
    title = (
        "Final scores as (score − random) / (human − random), over games × seeds; pairs have game and seed in common"
    )
    return titled(title, ["", "games", "seeds", "interquartile mean", "95 % interval"], rows)


def kl_table(stage: Stage) -> str:
    rows, curves = [], stage.compared
    for game, variant in itertools.product(games(curves), variants(curves)):
        if runs := list(seeds(curves, variant, game).values()):
            together = pd.concat(runs)
            kl = together.kl
            relative = share_above(kl, claims.spike_limit(stage, game))
            own = np.mean([claims.share_of_own_spikes(curve.kl) for curve in runs])
            far = share_above(together.max_tv_distance, claims.epsilons(stage.runs).get(variant, math.nan) / 2)
            row = [game, variant, str(len(runs)), last_step(curves, game)]
            row += [f"{number:.3g}" for number in (kl.mean(), kl.median(), kl.quantile(0.99), kl.max())]
            row += [cell(share, ".2%") for share in (relative, own, far)]
            rows.append([*row, f"{together.avg_clip_ratio.mean():.4f}"])
    columns = ["game", "variant", "seeds", "agent steps", "mean KL", "median", "99th percentile", "maximum"]
    columns += [f"spikes: above {stage.baseline}'s 99th percentile", "spikes: above 10 × own median"]
    columns += ["largest TV distance above ε / 2", "average clip ratio"]
    return titled("`losses/kl` (nats) over all iterations up to this step, and shares of them", columns, rows)


def names(stage: Stage) -> dict[str, str]:
    """Returns what the texts call the two variants, and what the clip ratio is to be near to."""
    near = f"{stage.epsilon:g} ({stage.epsilon - 0.02:g} to {stage.epsilon + 0.02:g})"
    base, new = (DISPLAY_NAMES.get(variant, variant) for variant in (stage.baseline, stage.challenger))
    return {"base": base, "new": new, "near": "which no run has" if math.isnan(stage.epsilon) else near}


def sign_and_count(margins: np.ndarray) -> str:
    """Returns the cell of a claim on a game: its verdict, and how many of the margins have the claim's sign."""
    ties = f", {(margins == 0).sum()} equal" if (margins == 0).any() else ""
    return f"{SIGNS[claims.judge(len(margins), margins)]} {(margins > 0).sum()} of {len(margins)}{ties}"


def claims_table(stage: Stage) -> str:
    rows = []
    for claim, margins in claims.find_margins(stage).items():
        sentence, form, unit = CLAIM_TEXTS[claim]
        strata = list((claims.in_human_ranges(margins) if claim == "score" else margins).values())
        cells = [*map(sign_and_count, margins.values()), "–"]
        if claim == "score" and stage.name == "unfinished":
            cells = [TOO_EARLY] * len(cells)
        elif len(strata) > 1 and any(map(len, strata)):
            scale = math.exp if claim == "KL" else float  # a KL's margin is the log of a ratio
            mean, interval = mean_and_interval(strata, lambda margin, s=scale, f=form: format(s(margin), f))
            judged = claims.judge(min(map(len, strata)), claims.bootstrap_interval(strata))
            cells[-1] = f"{SIGNS[judged]} {judged}: {unit.format(mean, **names(stage))} ({interval})"
        rows.append([sentence.format(**names(stage)), *cells])
    return titled("Claims of the thesis", ["claim", *games(stage.compared), "across games"], rows)


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
        rows.append([run, "score", *(cell(tenth.mean_return_100.tail(1).mean(), ",.0f") for tenth in tenths)])
        rows.append([run, "KL", *(cell(tenth.kl.mean(), ".2g") for tenth in tenths)])
    title = "Score at the end of each tenth of the schedule, and mean KL in it"
    return titled(title, ["run", "", *(f"{percent} %" for percent in range(10, 101, 10))], rows)


def short_table(stages: list[Stage]) -> str:
    """The project README's table: of each game, the pairs of its most advanced stage."""
    rows, (base, new, _) = {}, names(stages[0]).values()
    for stage in stages:
        margins = claims.find_margins(stage)
        for game in games(stage.compared):
            if game not in rows and (both := pairs(stage, game)):
                finals = [plus_minus(final.mean(), final.std()) for final in map(last_scores, zip(*both))]
                ratio = f"{math.exp(margins['KL'][game].mean()):.2f}"
                judged = sign_and_count(margins["score"][game]).replace(SIGNS[UNDECIDED], "undecided:") + " pairs"
                judged = judged if stage.name == "finished" else TOO_EARLY
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
    elif hours := [run["hours"]["wall"] for run in runs if run["hours"]]:
        text += f" They took {min(hours):.1f} to {max(hours):.1f} hours (known of {len(hours)})."
    if left_out := [f"{key[1]} {key[0]} {key[2]}" for key in stage.drawn if key not in stage.compared]:
        text += f" Only in the figures, being shorter than half of their game's longest: {', '.join(left_out)}."
    scripts = {(key[0], run["versions"].get("script")) for key, run in stage.runs.items()}
    if len(scripts) > len({variant for variant, _ in scripts}):
        text += " Some runs of a variant were trained by different versions of its script."
    bf16 = [f"{game} {name} {seed}" for (name, game, seed), run in stage.runs.items() if run["arguments"].get("bf16")]
    if len(bf16) in (0, len(runs)):
        return f"{text} All in {'bfloat16' if bf16 else 'float32'}.\n"
    return f"{text} In bfloat16: {', '.join(bf16)}; the others in float32.\n"


def results_part(stages: list[Stage], prefix: str = "") -> str:
    """Returns the generated part of a set's page; the names of its directories of figures begin with `prefix`."""
    parts = [LEGEND]
    for stage in stages:
        parts += [f"## {stage.name.capitalize()} runs\n", coverage(stage)]
        scores = [score_table(stage.compared), published_table(stage.compared)]
        scores += [evaluation_table(stage.runs), human_table(stage)] if stage.name == "finished" else []
        tables = (scores, [kl_table(stage)], [claims_table(stage), progress_table(stage)])
        for name, below in zip(FIGURES, tables):
            parts += [f"![{FIGURES[name][0]}](figures/{prefix}{stage.name}/{name}.png)\n", *filter(None, below)]
    return "\n".join(parts)


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    collect.collect(args.out, args.training_directories, args.note)
    runs, curves = collect.read_runs(args.out, args.note)
    if not runs:
        usage_error(f"--out {args.out}", f"no run there has {f'the note {args.note}' if args.note else 'no note'}")
    known = {variant for variant, _, _ in runs}
    for variant in {args.baseline, args.challenger} - known - {"ppo", "acppo"}:  # without these, there are figures
        usage_error(f"variant {variant}", f"no run is of it; give one of {', '.join(sorted(known))}")
    stages, prefix = claims.make_stages(runs, curves, args.baseline, args.challenger), args.note and f"{args.note}-"
    write_part(args.out / f"{args.note or 'README'}.md", results_part(stages, prefix))
    if args.out.resolve() == DEFAULT_OUT and (args.note, args.baseline, args.challenger) == ("", "ppo", "acppo"):
        write_part(ROOT / "README.md", short_table(stages))
    for stage in stages:
        draw(stage, args.out / "figures" / f"{prefix}{stage.name}")


if __name__ == "__main__":
    main()
