"""Draws the thesis's figures of one stage of runs, a panel for each game, as PNGs. `report.py` calls it."""

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

from benchmark.claims import VARIANT_ORDER, Stage, games, seeds, variants
from benchmark.collect import Curves
from wrappers import FRAME_SKIP, find_atari_game

# Figure → its title and the columns it shows, a row of panels for each, with its y axis
FIGURES = {
    "score": ("Score, mean of the last 100 games", {"mean_return_100": "points"}),
    "kl": ("KL divergence between policy updates", {"kl": "exact, nats", "old_approx_kl": "estimate, nats"}),
    "avg_clip_ratio": ("Average clip ratio", {"avg_clip_ratio": "mean clip range"}),
}
# Okabe and Ito's, which colour-blind readers can tell apart: of VARIANT_ORDER, then of other variants by name
COLOURS = ["#0072B2", "#D55E00", "#E69F00", "#56B4E9", "#009E73", "#CC79A7", "#F0E442", "#000000"]
SETTINGS = {"font.size": 11, "legend.title_fontsize": 13, "savefig.dpi": 80, "legend.frameon": False}
SETTINGS |= {"axes.titlesize": "small", "axes.grid": True, "grid.color": "0.9", "axes.axisbelow": True}


def draw(stage: Stage, directory: Path) -> None:
    """Writes DIRECTORY/NAME.png for each figure; equal curves give equal bytes."""
    directory.mkdir(parents=True, exist_ok=True)
    for name in FIGURES:
        file = directory / f"{name}.png"
        with matplotlib.rc_context({**matplotlib.rcParamsDefault, **SETTINGS}):  # not the user's matplotlibrc
            draw_figure(name, stage).savefig(file)
        # 128 colours take a third of the bytes and look the same; with 64, two variants can become one
        Image.open(file).convert("RGB").quantize(128, dither=Image.Dither.NONE).save(file, optimize=True)


def draw_figure(name: str, stage: Stage) -> Figure:
    (title, columns), curves = FIGURES[name], stage.drawn
    size = (max(9, 2.6 * len(games(curves))), 1 + 2.6 * len(columns))  # inches
    figure = Figure(figsize=size, layout="constrained")
    sharey = False if name == "score" else "row"  # points of two games do not compare
    axes = figure.subplots(len(columns), len(games(curves)), squeeze=False, sharey=sharey)
    for axis, (column, game) in zip(axes.flat, itertools.product(columns, games(curves))):
        frames = FRAME_SKIP if find_atari_game(game) else 1
        draw_panel(axis, curves, game, column, frames)
        counts = ", ".join(str(len(seeds(curves, variant, game))) for variant in variants(curves))
        x_label = "agent steps" if frames == 1 else "emulator frames"
        axis.set(title=f"{game}\nn = {counts}", xlabel=x_label, xlim=(0, None))
        axis.set_ylabel(columns[column] if axis.get_subplotspec().is_first_col() else "")
        axis.xaxis.set_major_formatter(EngFormatter(sep=""))
        axis.locator_params(axis="x", nbins=4)
    lines = [Line2D([], [], linewidth=3, label=name, color=colour(curves, name)) for name in variants(curves)]
    figure.legend(handles=lines, title=title, loc="outside upper center", ncols=6)
    return figure


def draw_panel(axis: Axes, curves: Curves, game: str, column: str, frames: int) -> None:
    """Draws one column of a game's runs, all variants; a step is so many frames."""
    for variant in variants({key: curve for key, curve in curves.items() if key[1] == game}):
        table = pd.DataFrame({seed: curve[column] for seed, curve in seeds(curves, variant, game).items()})
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
    order = dict.fromkeys([*VARIANT_ORDER, *variants(curves)])
    return COLOURS[list(order).index(variant) % len(COLOURS)]
