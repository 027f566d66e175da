"""Training directories → run directories, the form in which a run is kept in git.

    python benchmark/collect.py                                     # all of results/training
    python benchmark/collect.py runs/Qbert__mine__1__1700000000 --note first-try

A run directory is OUT/runs/GAME__VARIANT__SEED or, with a note, OUT/runs/GAME__VARIANT__SEED__NOTE. Its `run.json` has
arguments, commit, versions, machine, hours and the last evaluation; its `curve.csv.gz` has a row an iteration. The note
tells two runs of one game, variant and seed apart, and `report.py` compares the runs that have the same note.

A new run adds files and changes none. A training directory that is collected again, because it got further or was
evaluated, updates the run that it became. One with the thesis's schedule is read in six seconds.
"""

import gzip
import json
import re
import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import usage_error, write_file
from wrappers import canonical_name

ROOT = Path(__file__).resolve().parent.parent
DEFAULT_OUT = ROOT / "results"
LOSSES = "kl old_approx_kl avg_clip_ratio clipfrac tv_distance max_tv_distance max_ratio_advantage".split()
LOSSES += ["entropy", "explained_variance", "grad_norm"]
TAGS = {name: f"charts/{name}" for name in ("mean_return_100", "learning_rate")}
TAGS |= {name: f"losses/{name}" for name in LOSSES}

# By variant, game and seed: what run.json holds; and the curve, a row an iteration, by agent step (TAGS, games_ended)
Runs = dict[tuple[str, str, int], dict]
Curves = dict[tuple[str, str, int], pd.DataFrame]


@dataclass
class Args:
    training_directories: tyro.conf.Positional[tuple[Path, ...]] = ()
    """directories as the scripts leave them; without any, all in OUT/training"""
    out: Path = DEFAULT_OUT
    """directory of the results"""
    note: str = ""
    """a word for runs that must stand apart from those without one; a run collected before keeps its note"""


def collect(out: Path, directories: Sequence[Path] = (), note: str = "") -> list[Path]:
    """Brings OUT/runs up to date with all of the training directories, or with none if another run is in the way."""
    if not re.fullmatch(r"[\w.-]*", note):
        usage_error(f"--note {note}", "give letters, digits, '.', '_' and '-'")
    records = read_records(out)
    notes = {record["source"]: record["note"] for record in records.values()}
    found: dict[Path, tuple[dict, pd.DataFrame]] = {}
    for directory in directories or sorted(path for path in (out / "training").glob("*") if path.is_dir()):
        try:
            record, curve = read_training(directory)
        except (OSError, ValueError, LookupError, TypeError) as error:  # no run, or one without an iteration yet
            print(f"{directory}: left out ({type(error).__name__}: {error})", file=sys.stderr)
            continue
        record["note"] = notes.get(record["source"], note)
        words = [str(record[name]) for name in ("game", "variant", "seed", "note") if record[name] != ""]
        path = out / "runs" / re.sub(r"[^\w.-]", "-", "__".join(words))
        if path in found or records.get(path, record)["source"] != record["source"]:
            usage_error(f"{directory}", f"{path} holds another run; give --note NOTE to keep both")
        found[path] = record, curve
    for path, (record, curve) in found.items():  # equal content gives equal bytes
        path.mkdir(parents=True, exist_ok=True)
        rows = curve.to_csv(float_format="%.6g", lineterminator="\n")
        write_file(path / "curve.csv.gz", gzip.compress(rows.encode(), mtime=0))
        write_file(path / "run.json", json.dumps(record, indent=2, ensure_ascii=False) + "\n")  # the run is whole
    return list(found)


def read_training(directory: Path) -> tuple[dict, pd.DataFrame]:
    """Returns what a training directory's run.json and curve.csv.gz are to hold."""
    about = json.loads((directory / "args.json").read_text(encoding="utf-8"))
    files = sorted(directory.glob("events.out.tfevents*"))  # by their names, in the order of the run's starts
    readers = [EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload() for file in files]  # 0: all points
    tags = [(start, tag) for start, reader in enumerate(readers) for tag in reader.Tags()["scalars"]]
    if not tags:
        raise ValueError("it has no iterations")
    events = {(start, tag): pd.DataFrame(map(vars, readers[start].Scalars(tag))) for start, tag in tags}
    logged = pd.concat(events, names=["start", "tag"]).reset_index()  # columns: start, tag, wall_time, step, value
    args, curve, provenance = about["args"], make_curve(logged), read_provenance(readers, about["provenance"])
    ends = logged.groupby("start").wall_time.max()  # of each start; a pause lies between two of them
    wall = sum(end - readers[start].FirstEventTimestamp() for start, end in ends.items()) / 3600
    return {
        "variant": args["exp_name"],
        "game": canonical_name(args["env_id"]),  # by which published scores are found
        "seed": args["seed"],
        "note": "",
        "source": directory.resolve().name,
        "steps": int(curve.index[-1]),
        "total_timesteps": args["total_timesteps"],
        **{name: provenance.pop(name) for name in ("commit", "machine", "threads")},
        "hours": round(wall, 3),
        "evaluation": read_evaluation(directory / "eval.csv"),
        # Without the directory that it was logged to: a path of one machine, which tells nothing of the run
        "command": shlex.join(word for word in shlex.split(about["command"]) if not word.startswith("--log-dir=")),
        "arguments": {name: value for name, value in args.items() if name != "log_dir"},
        "versions": provenance,
    }, curve


def make_curve(logged: pd.DataFrame) -> pd.DataFrame:
    """Returns the tags in TAGS by agent step, and the games ended so far; of a step logged twice, the last."""
    table = logged[logged.tag.isin(TAGS.values())].drop_duplicates(["tag", "step"], keep="last")
    table = table.pivot(index="step", columns="tag", values="value").reindex(columns=list(TAGS.values()))
    game_ends = np.sort(logged.step[logged.tag == "charts/episodic_return"])
    games_ended = np.searchsorted(game_ends, table.index, side="right")
    return table.set_axis(list(TAGS), axis=1).assign(games_ended=games_ended)


def read_provenance(readers: list[EventAccumulator], last: dict[str, object]) -> dict[str, str]:
    """Returns what each start wrote to TensorBoard, each value once; `last` is the last start's, from args.json."""
    tag = "provenance/text_summary"
    events = [event for reader in readers if tag in reader.Tags()["tensors"] for event in reader.Tensors(tag)]
    lines = [line for event in events for line in event.tensor_proto.string_val[0].decode().splitlines()]
    pairs = [line.strip("|").split("|", 1) for line in lines] + [[name, str(value)] for name, value in last.items()]
    return {name: "; ".join(dict.fromkeys(value for key, value in pairs if key == name)) for name in last}


def read_evaluation(file: Path) -> dict[str, float | None] | None:
    """Returns games, mean and sample standard deviation of the last step in eval.csv, None without a file.

    A game that was played again counts once. Files of older runs do not say its seed.
    """
    if not file.exists():
        return None
    table = pd.read_csv(file, encoding="utf-8")
    last = table[table.step == table.step.max()]
    last = last.drop_duplicates([name for name in ("seed", "game") if name in table], keep="last")
    mean, std = (float(f"{number:.6g}") for number in (last.score.mean(), last.score.std(ddof=1)))
    return {"games": len(last), "mean": mean, "std": std if len(last) > 1 else None}


def read_records(out: Path) -> dict[Path, dict]:
    """Returns run directory → what its run.json holds, of all notes."""
    files = sorted((out / "runs").glob("*/run.json"))
    return {file.parent: json.loads(file.read_text(encoding="utf-8")) for file in files}


def read_runs(out: Path, note: str = "") -> tuple[Runs, Curves]:
    """Returns the runs that have this note, and their curves."""
    runs, curves = {}, {}
    for path, record in read_records(out).items():
        if record["note"] == note:
            key = record["variant"], record["game"], record["seed"]
            curve = pd.read_csv(path / "curve.csv.gz", index_col="step", encoding="utf-8")
            runs[key], curves[key] = record, curve.reindex(columns=[*TAGS, "games_ended"])  # older runs lack some
    return runs, curves


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    paths = collect(args.out, args.training_directories, args.note)
    if not paths:
        usage_error(f"--out {args.out}", "give training directories in which an iteration has ended")
    print(*paths, sep="\n")


if __name__ == "__main__":
    main()
