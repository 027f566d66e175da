"""Draws the thesis's figures of one stage of runs, a panel for each game, as PNGs. `report.py` calls it."""

import io
import itertools
import math
from pathlib import Path

import matplotlib
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import withStroke
from matplotlib.ticker import EngFormatter, NullFormatter
from PIL import Image

from benchmark.claims import Stage, games, seeds, variants
from benchmark.collect import Curves
from bookkeeping import write_file
from wrappers import FRAME_SKIP, find_atari_game

# Figure → its title and the columns it shows, a row of panels for each, with its y axis
FIGURES = {
    "score": ("Score, mean of the last 100 games", {"mean_return_100": "points"}),
    "kl": ("KL divergence between policy updates", {"kl": "exact, nats", "old_approx_kl": "estimate, nats"}),
    "avg_clip_ratio": ("Average clip ratio", {"avg_clip_ratio": "mean clip range"}),
}
# Okabe and Ito's colours, which colour-blind readers can tell apart
COLOURS = {"ppo": "#0072B2", "acppo": "#D55E00", "ppo-matched": "#E69F00", "ppo-wide": "#56B4E9", "product": "#009E73"}
SPARE_COLOURS = ("#CC79A7", "#F0E442", "#000000")  # of other variants, by name
SETTINGS = {"font.size": 11, "legend.title_fontsize": 13, "savefig.dpi": 80}


def draw(stage: Stage, directory: Path) -> None:
    """Writes DIRECTORY/NAME.png for each figure; equal curves give equal bytes."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        with matplotlib.rc_context({**matplotlib.rcParamsDefault, **SETTINGS}):  # not the user's matplotlibrc
            draw_figure(name, stage).savefig(drawn := io.BytesIO(), format="png")
        # 128 colours take a third of the bytes and look the same; with 64, two variants can become one
        palette = Image.open(drawn).convert("RGB").quantize(128, dither=Image.Dither.NONE)
        palette.save(small := io.BytesIO(), format="png", optimize=True)
        write_file(directory / f"{name}.png", small.getvalue())


def draw_figure(name: str, stage: Stage) -> Figure:
    (title, columns), curves = FIGURES[name], stage.drawn
    size = (max(9, 2.6 * len(games(curves))), 1 + 2.6 * len(columns))  # inches
    figure = Figure(figsize=size, layout="constrained", facecolor="white")
    sharey = False if name == "score" else "row"  # points of two games do not compare
    axes = figure.subplots(len(columns), len(games(curves)), squeeze=False, sharey=sharey)
    for axis, (column, game) in zip(axes.flat, itertools.product(columns, games(curves))):
        frames = FRAME_SKIP if find_atari_game(game) else 1
        draw_panel(axis, curves, game, column, frames)
        counts = ", ".join(str(len(seeds(curves, variant, game))) for variant in variants(curves))
        axis.set_title(f"{game}\nn = {counts}", fontsize="small")
        axis.set_xlabel("agent steps" if frames == 1 else "emulator frames")
        axis.set_ylabel(columns[column] if axis.get_subplotspec().is_first_col() else "")
        axis.set_xlim(left=0)
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.locator_params(axis="x", nbins=4)
        axis.grid(color="0.9")
        axis.set_axisbelow(True)
        if name == "avg_clip_ratio" and math.isfinite(stage.epsilon):
            axis.axhline(stage.epsilon, color=colour(curves, stage.baseline), linestyle="--", linewidth=1.5)
    lines = [Line2D([], [], linewidth=3, label=name, color=colour(curves, name)) for name in variants(curves)]
    figure.legend(handles=lines, title=title, loc="outside upper center", ncols=6, frameon=False)
    return figure


def draw_panel(axis: Axes, curves: Curves, game: str, column: str, frames: int) -> None:
    """Draws one column of a game's runs, all variants; a step is so many frames."""
    for variant in variants(curves):
        table = pd.DataFrame({seed: curve[column] for seed, curve in seeds(curves, variant, game).items()})
        if table.empty:
            continue
        color, x = colour(curves, variant), table.index * frames
        if column == "mean_return_100":
            middle, std = table.mean(axis=1, skipna=False), table.std(axis=1, skipna=False)  # NaN for one seed
            axis.fill_between(x, middle - std, middle + std, color=color, alpha=0.2, linewidth=0)
        else:  # has spikes, or noise from one iteration to the next
            window = max(1, len(table) // 20)
            running = table.rolling(window, center=True, min_periods=1).median()
            middle = running.where(table.notna()).median(axis=1, skipna=False)
        axis.plot(x, table, color=color, linewidth=0.6, alpha=0.3, antialiased=False)
        # A white edge against the mass of its own colour in long runs; a score's would hide the other variant
        edge = [] if column == "mean_return_100" else [withStroke(linewidth=4, foreground="white")]
        axis.plot(x, middle, color=color, linewidth=2, zorder=3, path_effects=edge)
    if column == "old_approx_kl":  # has both signs: linear up to about its median size
        median = pd.concat([curve.kl for curve in curves.values()]).median()
        axis.set_yscale("symlog", linthresh=10.0 ** round(math.log10(median)) if median > 0 else 1)
    elif column == "kl":
        axis.set_yscale("log")
        axis.yaxis.set_minor_formatter(NullFormatter())  # only powers of ten have a number


def colour(curves: Curves, variant: str) -> str:
    """Returns a variant's colour, the same in all figures."""
    others = [name for name in variants(curves) if name not in COLOURS]
    return COLOURS.get(variant) or SPARE_COLOURS[others.index(variant) % len(SPARE_COLOURS)]
