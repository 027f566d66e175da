"""Event files → OUT/runs.csv, a row a run, and OUT/curves.csv, a row an iteration.

    python benchmark/collect.py
    python benchmark/collect.py --out ../another-grid

Every run directory under OUT/runs is read, a thesis-sized one in six seconds. Runs that are in the CSVs already and
have no directory here keep their rows, so that grids of several machines add up. A run that is found replaces its own
rows, also those of a run that got further (said on standard error).
"""

import csv
import json
import re
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import parse, refuse, say, tell, write_text

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_OUT = ROOT / "benchmark" / "results"
LOSSES = "kl old_approx_kl avg_clip_ratio clipfrac tv_distance max_tv_distance max_ratio_advantage".split()
LOSSES += ["entropy", "explained_variance"]
TAGS = {"mean_return_100": "charts/mean_return_100", **{name: f"losses/{name}" for name in LOSSES}}
TAGS["learning_rate"] = "charts/learning_rate"
KEY = ["variant", "game", "seed"]
# The evaluation: of the agent at its last checkpoint, sample standard deviation (ddof 1)
EVALUATION = ["eval_games", "eval_mean", "eval_std"]
RUN_COLUMNS = [*KEY, *"steps total_timesteps command arguments commit versions machine threads".split(), *EVALUATION]
CURVE_COLUMNS = [*KEY, "step", *TAGS, "games_ended"]  # the last: since the start
PLACE = ("commit", "machine", "threads")  # of a run's provenance, these have a column each; the rest are versions


@dataclass
class Args:
    out: Path = DEFAULT_OUT
    """directory of the grid: its runs are in OUT/runs, and the CSVs are written beside that"""


def collect(out: Path) -> None:
    """Brings OUT/runs.csv and OUT/curves.csv up to date with the run directories under OUT/runs."""
    found: dict[tuple, tuple[str, dict, pd.DataFrame]] = {}
    directories = sorted(path for path in (out / "runs").iterdir() if path.is_dir()) if (out / "runs").is_dir() else []
    for directory in directories:
        try:
            run, curve = read_run(directory)
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:  # it is not as it should be
            say(f"{directory}: left out ({type(error).__name__}: {error})")
            continue
        key = tuple(run[name] for name in KEY)
        if key in found:
            other, kept, _ = found[key]
            names = (other, directory.name) if kept["steps"] > run["steps"] else (directory.name, other)
            say(f"{' '.join(map(str, key))}: {names[0]} counts, {names[1]} got no further")
        if key not in found or run["steps"] >= found[key][1]["steps"]:
            found[key] = (directory.name, run, curve)
    if not found:
        return
    runs, curves = read_csvs(out)
    for *key, before in runs[[*KEY, "steps"]].itertuples(index=False):
        if tuple(key) in found and before > (steps := found[tuple(key)][1]["steps"]):
            say(f"{' '.join(map(str, key))}: {steps} steps replace {before}")
    new_runs = pd.DataFrame([run for _, run, _ in found.values()], columns=RUN_COLUMNS)
    new_curves = pd.concat([curve for _, _, curve in found.values()])
    for name, known, new in (("runs.csv", runs, new_runs), ("curves.csv", curves, new_curves)):
        kept = known[[key not in found for key in known[KEY].itertuples(index=False, name=None)]]
        table = pd.concat([kept, new]) if len(kept) else new
        table = table.sort_values(list(table.columns[:4]))  # the key and the step: a small diff
        write_text(out / name, table.to_csv(index=False, float_format="%.6g", lineterminator="\n"))


def read_run(directory: Path) -> tuple[dict, pd.DataFrame]:
    """Returns a run's row of runs.csv and its rows of curves.csv."""
    record = json.loads((directory / "args.json").read_text(encoding="utf-8"))
    args, readers = record["args"], read_events(directory)
    key = dict(zip(KEY, (args["exp_name"], args["env_id"], args["seed"])))
    curve = read_curve(readers)
    if not len(curve):
        raise ValueError("it has no iterations")
    # args.json has the last start's; if starts differ, each value counts once
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
        **read_evaluation(directory),
    }
    return run, curve.reset_index().assign(**key)[CURVE_COLUMNS]


def read_events(directory: Path) -> list[EventAccumulator]:
    """Reads a run's event files, every point of them; the order of their names is that of the run's starts."""
    files = sorted(directory.glob("events.out.tfevents*"))
    return [EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload() for file in files]


def read_curve(readers: list[EventAccumulator]) -> pd.DataFrame:
    """Returns the tags in TAGS by agent step, and the games ended so far; of a step logged twice, the last."""
    points, game_ends = [], []
    for reader in readers:
        logged = reader.Tags()["scalars"]
        for column, tag in TAGS.items():
            if tag in logged:
                points += [(event.step, column, event.value) for event in reader.Scalars(tag)]
        if "charts/episodic_return" in logged:
            game_ends += [event.step for event in reader.Scalars("charts/episodic_return")]
    table = pd.DataFrame(points, columns=["step", "column", "value"])
    table = table.drop_duplicates(["step", "column"], keep="last")
    table = table.pivot(index="step", columns="column", values="value").reindex(columns=list(TAGS)).sort_index()
    return table.assign(games_ended=np.searchsorted(np.sort(game_ends), table.index, side="right"))


def read_provenance(readers: list[EventAccumulator]) -> list[dict[str, str]]:
    """Returns the provenance that each start of a run wrote to TensorBoard, from the first to the last."""
    tag, texts = "provenance/text_summary", []
    for reader in readers:
        texts += reader.Tensors(tag) if tag in reader.Tags()["tensors"] else []
    tables = [text.tensor_proto.string_val[0].decode() for text in texts]
    return [dict(line.strip("|").split("|", 1) for line in table.splitlines()) for table in tables]


def read_evaluation(directory: Path) -> dict[str, float]:
    """Returns the columns of the last evaluation in a run's eval.csv; an earlier one may have had the same games."""
    scores: list[float] = []
    if (directory / "eval.csv").exists():
        with open(directory / "eval.csv", encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                scores = [] if row["game"] == "1" else scores
                scores.append(float(row["score"]))
    std = np.std(scores, ddof=1) if len(scores) > 1 else np.nan
    return dict(zip(EVALUATION, (len(scores), np.mean(scores), std) if scores else (np.nan,) * 3))


def read_csvs(out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Returns OUT/runs.csv and OUT/curves.csv, without rows if they are not there yet."""
    tables = []
    whole = dict.fromkeys(("seed", "steps", "total_timesteps", "step", "games_ended"), "int64")
    measured = dict.fromkeys((*TAGS, *EVALUATION), "float64")  # may be empty, and in older CSVs missing
    for name, columns in (("runs.csv", RUN_COLUMNS), ("curves.csv", CURVE_COLUMNS)):
        types = {column: (whole | measured).get(column, "str") for column in columns}
        try:
            table = pd.read_csv(out / name, dtype=types, encoding="utf-8")
        except FileNotFoundError:
            table = pd.DataFrame({column: pd.Series(dtype=dtype) for column, dtype in types.items()})
        except (OSError, ValueError) as error:
            refuse(f"--out {out / name}", f"cannot be read ({str(error).splitlines()[0]})")
        if not set(columns) - set(measured) <= set(table) <= set(columns):
            refuse(f"--out {out / name}", "has other columns than this command writes; move it away")
        tables.append(table.reindex(columns=columns))
    return tuple(tables)


def read_grid(out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Collects what is under OUT and returns its CSVs. Ends the program with status 2 if there is nothing."""
    if not (out / "runs").is_dir() and not (out / "curves.csv").exists():
        refuse(f"--out {out}", "has neither runs nor their CSVs; run benchmark/atari5.py first")
    collect(out)
    runs, curves = read_csvs(out)
    if runs.empty or curves.empty:
        refuse(f"--out {out}", "no run there has an iteration yet")
    return runs, curves


def main() -> None:
    args = parse(Args, description=__doc__)
    try:
        runs, curves = read_grid(args.out)
    except OSError as error:
        refuse(f"--out {args.out}", f"cannot use {error.filename} ({error.strerror})")
    tell(f"{args.out}: {len(runs)} runs, {len(curves):,} iterations")


if __name__ == "__main__":
    main()
