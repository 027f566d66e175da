"""The thesis's figures and tables, and the verdicts on its claims, from the grid's event files.

    python benchmark/figures.py
    python benchmark/figures.py --out ../another-grid --baseline ppo --challenger mine

`collect.py` brings OUT/runs.csv and OUT/curves.csv up to date, and everything else is made from these two alone:
OUT/figures/STAGE/*.png and *.svg, and in OUT/README.md, between `<!-- results -->` and `<!-- end results -->`, the
tables and verdicts of `claims.py`, on two variants and with others beside them. The default grid's short table of the
thesis's two goes between the same two marks of the project's README. What stands outside the marks stays.

A stage is `finished` or `beginnings`. Each game of `finished` shows its finished runs as far as they got; each game of
`beginnings` all its runs, as far as the longest unfinished one.
"""

import io
import itertools
import json
import math
import os
import re
import sys
import textwrap
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    os.environ["MPLBACKEND"] = "agg"  # no window is opened, and matplotlib would fail on a backend that it lacks

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter, NullFormatter

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark.claims import (
    FEWEST_PAIRS,
    FINISHED,
    UNDECIDED,
    Curves,
    Stage,
    claims_table,
    epsilons,
    evaluation_table,
    games,
    human_table,
    kl_table,
    make_stages,
    progress_table,
    score_table,
    seeds,
    short_table,
    spikes_table,
    total_timesteps,
    variants,
)
from benchmark.collect import DEFAULT_OUT, KEY, ROOT, read_grid
from benchmark.readme import split_readme, write_part
from bookkeeping import parse, refuse, tell, write_bytes, write_text
from wrappers import FRAME_SKIP, find_atari_game

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
# Okabe and Ito's colours, which colour-blind readers can tell apart
COLOURS = {"ppo": "#0072B2", "acppo": "#D55E00", "ppo-matched": "#E69F00", "ppo-wide": "#56B4E9", "product": "#009E73"}
SPARE_COLOURS = ("#CC79A7", "#F0E442", "#000000")  # of other variants, by name; then again with other dashes
DASHES = ("-", "--", ":", "-.")
LONG = 1000  # iterations; longer runs get smooth lines and pixels for the rest


@dataclass
class Args:
    out: Path = DEFAULT_OUT
    """directory of the grid: its runs are in OUT/runs, and everything made of them is written beside that"""
    baseline: str = "ppo"
    """variant that the other one is held against, by its seeds, its ε and its KL's 99th percentile"""
    challenger: str = "acppo"
    """variant that the verdicts are on"""


def frames_per_step(game: str) -> int:
    """Returns the emulator frames of an agent step: 4 on Atari, 1 elsewhere."""
    return FRAME_SKIP if find_atari_game(game) else 1


def style(curves: Curves, variant: str) -> dict[str, str]:
    """Returns a variant's colour and dashes, the same in all figures."""
    if variant in COLOURS:
        return {"color": COLOURS[variant], "linestyle": "-"}
    others = [name for name in variants(curves) if name not in COLOURS]
    turn, colour = divmod(others.index(variant), len(SPARE_COLOURS))
    return {"color": SPARE_COLOURS[colour], "linestyle": DASHES[turn % len(DASHES)]}


def captions(stage: Stage) -> dict[str, str]:
    """Returns figure → caption."""
    runs, curves = stage.runs, stage.drawn
    band = "One seed, so no band."
    if runs.seed.nunique() > 1:
        band = "Line and band: mean ± sample standard deviation (ddof 1) over the n seeds that a panel's title gives, "
        band += "as far as all of a variant's have got; thin: each seed. If n = 1 there is no band."
    spikes = "Thin: every iteration of each seed. Thick: running median over a twentieth of them, then over a "
    spikes += "variant's seeds, as far as all have got."
    kl = pd.concat([curve.kl for curve in curves.values()]).median()
    samples = sorted({args["num_envs"] * args["num_steps"] for args in map(json.loads, runs.arguments)})
    noise = f"√(2 KL / {samples[0]:,}), {math.sqrt(2 * kl / samples[0]):.1g} at the median KL {kl:.1g}"
    bounds = ", ".join(f"{epsilon / 2:g} for {variant}" for variant, epsilon in epsilons(runs).items())
    taken = " or ".join(f"{number:,}" for number in samples)
    estimator = f"the thesis's estimator, the mean of log π − log π_new over the {taken} actions taken"
    bound = "which bounds the maximum while every ratio is inside its range (proposition 2.4.1)"
    dashed = f" Dashed: {stage.words()['base']}'s ε = {stage.epsilon:g}." if math.isfinite(stage.epsilon) else ""
    texts = {
        "score": band,
        "kl": "Top: exact over actions, mean over the rollout's states. "
        f"Bottom: {estimator}; its noise is about {noise}, so it can be negative. {spikes}",
        "avg_clip_ratio": f"Clip range, mean over an iteration's samples.{dashed} {spikes}",
        "tv_distance": "Top: mean over the rollout's states. Bottom: its maximum over them. "
        f"Dashed, in the variant's colour: ε / 2 ({bounds}), {bound}. {spikes}",
        "ratio_advantage": f"Theorem 3.1.1's δ on the rollout's samples; Â normalised over the rollout. {spikes}",
    }
    return {name: f"{text} {bf16_note(runs)}" for name, text in texts.items()}


def draw_figure(name: str, stage: Stage) -> Figure:
    """Draws a panel for each game: three in a line, or if the figure has two columns a line for each."""
    (title, columns), curves = FIGURES[name], stage.drawn
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
        lines = {stage.baseline: stage.epsilon} if name == "avg_clip_ratio" and math.isfinite(stage.epsilon) else {}
        if name == "tv_distance":
            lines = {variant: epsilon / 2 for variant, epsilon in epsilons(stage.runs).items() if variant in counts}
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
    figure.supxlabel(textwrap.fill(captions(stage)[name], int(width * 11)), x=0.01, ha="left", fontsize="small")
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
        pixels = len(table) > LONG  # in the SVG too, in which a line of 5,000 points in every panel makes megabytes
        axis.plot(x, table, color=look["color"], linewidth=0.6, alpha=0.4, rasterized=pixels)
        # A white edge against the mass of its own colour in long runs; a score's would hide the other variant
        edge = [] if column == "mean_return_100" else [withStroke(linewidth=4, foreground="white")]
        axis.plot(x, middle, linewidth=2, zorder=3, path_effects=edge, **look)
    if column == "old_approx_kl":  # has both signs: linear up to about its median size
        median = pd.concat([curve.kl for curve in curves.values()]).median()
        axis.set_yscale("symlog", linthresh=10.0 ** round(math.log10(median)) if median > 0 else 1)
    elif column not in ("mean_return_100", "avg_clip_ratio"):
        axis.set_yscale("log")
        axis.yaxis.set_minor_formatter(NullFormatter())  # names powers of ten alone


def draw(out: Path, stages: list[Stage]) -> None:
    """Makes OUT/figures."""
    settings = {"font.size": 13, "legend.title_fontsize": 15, "savefig.dpi": 100, "svg.hashsalt": "acppo"}
    for stage, name in itertools.product(stages, FIGURES):
        (directory := out / "figures" / stage.name).mkdir(parents=True, exist_ok=True)
        with matplotlib.rc_context({**matplotlib.rcParamsDefault, **settings}):  # not the user's matplotlibrc
            figure = draw_figure(name, stage)
            for suffix, metadata in (("png", {}), ("svg", {"Date": None})):  # equal CSVs give equal files
                figure.savefig(file := io.BytesIO(), format=suffix, metadata=metadata)
                write_bytes(directory / f"{name}.{suffix}", file.getvalue())


# ------------------------------------------------------------------------------------------------- OUT/README.md
def how_to_read(stage: Stage) -> str:
    old, new = stage.baseline, stage.challenger
    return f"""KL is that between policy updates (`losses/kl`, nats, exact over actions), of every iteration up to the
step given; shares are of iterations, and {old}'s above its own 99th percentile is about 1 % by definition. The largest
TV distance is over the visited states; ε / 2 bounds it only while every ratio is inside its range (proposition 2.4.1).

The thesis's claims: ✓ holds, ✗ does not hold, ? {UNDECIDED}. A game is judged by its
pairs of {old} and {new} with the same seed (the clip ratio by runs of {new}): {FEWEST_PAIRS} or more must be there, and
all must agree; the table counts those with the claim's sign. Across games, the 95 % interval of the margins'
interquartile mean must exclude "no difference"; with three seeds a game it does so for two equal algorithms one time
in ten, not in twenty. A final score is judged only by runs that have done {100 * FINISHED:.0f} % of their schedule.
The whole rule, and since when it stands, opens `benchmark/claims.py`.

Each run's arguments, versions, machine and commit are in `runs.csv`, each of its iterations in `curves.csv`.
"""


def bf16_note(runs: pd.DataFrame) -> str:
    """Says which of these runs are in bfloat16."""
    keys = [run for run in runs.itertuples() if json.loads(run.arguments).get("bf16")]
    if len(keys) in (0, len(runs)):
        return f"All in {'bfloat16' if keys else 'float32'}."
    return f"In bfloat16: {', '.join(f'{run.game} {run.variant} {run.seed}' for run in keys)}; the others in float32."


def coverage(stage: Stage) -> str:
    """Says which runs a stage is made of, and how much of their schedule they have done."""
    runs, totals = stage.runs, total_timesteps(stage.runs)
    done = [100 * curve.index[-1] / totals[key] for key, curve in stage.drawn.items()]
    share = " to ".join(dict.fromkeys(f"{percent:.3g} %" for percent in (min(done), max(done))))
    names = {name: ", ".join(map(str, sorted(runs[name].unique()))) for name in KEY}
    commits = sorted({commit[:7] for of_run in runs.commit for commit in of_run.split("; ")})
    machines = sorted({machine for of_run in runs.machine for machine in of_run.split("; ")})
    schedules = " or ".join(f"{steps:,}" for steps in sorted(runs.total_timesteps.unique()))
    text = (
        f"{len(runs)} runs (variants {names['variant']}; games {names['game']}; seeds {names['seed']}), at {share} of a"
        f" schedule of {schedules} agent steps."
    )
    if not stage.final:
        text += " This is so at these steps, and says nothing about the schedule's end."
    left_out = [f"{key[1]} {key[0]} {key[2]}" for key in stage.drawn if key not in stage.compared]
    if left_out:
        text += f" In the figures alone, being shorter than half of their game's longest: {', '.join(left_out)}."
    texts = {(run.variant, text) for run in runs.itertuples() for text in re.findall(r"sha256 \w+", run.versions)}
    counts = Counter(variant for variant, _ in texts)
    if several := sorted(variant for variant, count in counts.items() if count > 1):
        text += f" Trained by more than one text of the script: {', '.join(several)}."
    return f"{text} {bf16_note(runs)} Commits {', '.join(commits)}; {'; '.join(machines)}.\n"


def stage_tables(stage: Stage) -> dict[str, str]:
    """Returns the tables by the name of the figure that they stand under."""
    scores = [score_table(stage.compared)]
    judged = [kl_table(stage), claims_table(stage)]
    if stage.final:
        scores += [evaluation_table(stage.runs), human_table(stage)]
    if stage.long:
        judged += [progress_table(stage), spikes_table(stage.compared)]
    return {"score": "\n".join(filter(None, scores)), "kl": "\n".join(judged)}


def results_part(stages: list[Stage]) -> str:
    """Returns the generated part of OUT/README.md."""
    parts = [how_to_read(stages[0])]
    for stage in stages:
        parts += [f"## {'Finished runs' if stage.final else 'Beginnings'}\n", coverage(stage)]
        for name, tables in stage_tables(stage).items():
            parts += [f"![{FIGURES[name][0]}. {captions(stage)[name]}](figures/{stage.name}/{name}.png)\n", tables]
        links = ", ".join(f"[{name}](figures/{stage.name}/{name}.svg)" for name in FIGURES)
        parts += [f"All figures: {links}.\n"]
    return "\n".join(parts)


def main() -> None:
    args = parse(Args, description=__doc__)
    try:
        runs, curves = read_grid(args.out)
        known = sorted(runs.variant.unique())
        for name in ("baseline", "challenger"):
            # A grid without ppo or acppo has its figures, too
            if (variant := getattr(args, name)) not in (*known, getattr(Args, name)):
                refuse(f"--{name} {variant}", f"no run is of this variant; give one of {', '.join(known)}")
        if args.baseline == args.challenger:
            refuse(f"--challenger {args.challenger}", "is the baseline, too; give another")
        stages = make_stages(runs, curves, args.baseline, args.challenger)
        readme = args.out / "README.md"
        if not readme.exists():
            write_text(readme, "# Results\n\n<!-- results -->\n<!-- end results -->\n")
        written = [(readme, results_part(stages))]
        if args.out.resolve() == DEFAULT_OUT and (args.baseline, args.challenger) == (Args.baseline, Args.challenger):
            written.append((ROOT / "README.md", short_table(stages)))
        for readme, _ in written:
            if split_readme(readme, "results") is None:
                refuse(str(readme), "has no <!-- results --> … <!-- end results -->, once, to write between")
        draw(args.out, stages)
        for readme, part in written:
            write_part(readme, "results", part)
    except OSError as error:
        refuse(f"--out {args.out}", f"cannot use {error.filename} ({error.strerror})")
    tell(f"{args.out}: runs.csv, curves.csv, figures/, README.md")


if __name__ == "__main__":
    main()
