"""Agent steps per second of the training scripts, of other PPOs in the same call, and of the processor itself.

    python benchmark/throughput.py ppo_atari.py acppo_atari.py
    python benchmark/throughput.py ppo_atari.py "ppo_atari.py --bf16" --peer --cleanrl ../cleanrl
    python benchmark/throughput.py ppo_atari.py --jobs 1 2
    python benchmark/throughput.py ppo_atari.py "ppo_atari.py --resume runs/Breakout__ppo_atari__1__1700000000"
    python benchmark/throughput.py ppo_atari.py --num-envs 8 16 32 64 --threads 1 2
    python benchmark/throughput.py --table

A contender is a script with its flags, in one string. Each run is a whole process on the processor alone, no GPU, and
is read from what it logged. Runs are interleaved, A B A B, and compared round by round: a machine whose speed drifts
by 20 % moves both sides of a ratio alike, and the same script given twice shows how much noise is left. With
`--jobs 2` a contender runs as two processes that share the threads, and their steps/s add up over the time in which
both are past their warm-up. With `--resume` a contender goes on from a copy of that run's checkpoint, for the speed of
the end of a run.

Standard output gets three tables: speed; where an iteration's time goes; and how far each run is from two limits
measured just before, the convolutions that the processor can compute and the steps that the bare emulator can make.
The CSV gets a row for each process as soon as it ends, `time/…` in seconds. Expect about a minute for each contender
and round at 600 steps/s. `--table` measures nothing: it writes the README's table of speed, between `<!-- speed -->`
and `<!-- end speed -->`, from the CSVs that are committed, `results/throughput_KIND.csv`, one a kind of processor.

`--peer` needs `pip install -e '.[peer]'`. CleanRL needs an older Gymnasium and so an interpreter of its own,
`--cleanrl-python`: one that has torch, gymnasium 0.29.1, ale-py 0.10.1, numpy 1, opencv-python-headless 4,
tensorboard and tyro.
"""

import csv
import importlib.metadata
import io
import itertools
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime, timezone
from pathlib import Path
from statistics import median

import gymnasium as gym
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark.limits import AGENT_STEP, KL_PASS, LIMITS, in_own_process, measure_limits
from benchmark.readme import markdown, write_part
from bookkeeping import available_cores, commit_of, kind_of_processor, parse, refuse, say, tell, write_text
from wrappers import find_atari_game

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmark" / "results"
NUM_STEPS = 128  # agent steps of each environment in one iteration (appendix A): the default of every contender
OF_PROCESS = ("time/first_iteration", "time/iteration", "time/unaccounted")  # every other `time/…` is a phase
# A script's phases follow, by the names that it logs them under
CSV_FIELDS = "call date env_id contender commit torch cpu kind round job num_envs threads jobs warmup window".split()
CSV_FIELDS += ["steps_per_second", "peak_mb", *LIMITS, *OF_PROCESS]
IN_README = ("ppo_atari.py", "ppo_atari.py --bf16")  # contenders of the README's table


@dataclass
class Args:
    contenders: tyro.conf.Positional[tuple[str, ...]] = ()
    """scripts to measure, each with its flags in one string; all are compared with the first"""
    env_id: str = "Breakout"
    """the environment, named as for the scripts; limits and peers need an Atari game"""
    rounds: int = 3
    """times that every contender is run"""
    warmup: int = 3
    """iterations before the window, in which memory and caches settle"""
    window: int = 30
    """iterations that are measured"""
    threads: tuple[int, ...] = field(default_factory=lambda: (available_cores(),))
    """threads of a contender, over all its jobs; the default is the cores this process may use. Several values give
    a row each, as for the next two"""
    jobs: tuple[int, ...] = (1,)
    """processes that a contender is run as at once, with threads / jobs each, at least 1"""
    num_envs: tuple[int, ...] = (8,)
    """environments that a process plays at once"""
    peer: bool = False
    """measure Stable-Baselines3's PPO too"""
    cleanrl: Path | None = None
    """measure cleanrl/ppo_atari.py of this checkout of CleanRL too"""
    cleanrl_python: str = sys.executable
    """the interpreter that CleanRL is run with"""
    csv: Path = RESULTS / "throughput.csv"
    """file that the rows are added to"""
    table: bool = False
    """measure nothing, write the README's table"""

    def check(self) -> None:
        """Ends the program with status 2 at the first argument that cannot work."""
        for name in ("rounds", "warmup", "window", "threads", "jobs", "num_envs"):
            given = getattr(self, name)
            if (smallest := min(given) if isinstance(given, tuple) else given) < 1:
                refuse(f"--{name.replace('_', '-')} {smallest}", "give a number above 0")
        if not self.contenders:
            refuse("no contender", "name a script, for example ppo_atari.py")
        try:
            atari = find_atari_game(self.env_id)
        except ValueError as error:
            refuse(f"--env-id {self.env_id}", error)
        if (self.peer or self.cleanrl) and (atari is None or atari[1] > 0):
            refuse(f"--env-id {self.env_id}", "peers play Atari without sticky actions; give a game such as Breakout")


def peer_id(env_id: str) -> str:
    """Returns the name that peers know a game by."""
    rom, _ = find_atari_game(env_id)
    specs = (spec for spec in gym.registry.values() if spec.namespace == "ALE" and spec.kwargs["game"] == rom)
    return f"{next(specs).name}NoFrameskip-v4"


def read_csv(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Returns the names of a CSV's columns, and its rows."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(reader := csv.DictReader(file))
        return list(reader.fieldnames or []), rows


def add_rows(path: Path, rows: list[dict[str, object]]) -> None:
    """Adds rows to a CSV, and a column for each phase that it has not had; cells without a value stay empty."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path if path.exists() else path.parent, os.W_OK):
            raise PermissionError(13, "Permission denied")
        header, known = read_csv(path) if path.exists() else (CSV_FIELDS, [])
        if not {"contender", "steps_per_second"} <= set(header):
            refuse(f"--csv {path}", "it holds other columns than these runs have; give another file")
        if rows:
            columns = list(dict.fromkeys([*header, *(name for row in rows for name in row)]))
            writer = csv.DictWriter(text := io.StringIO(newline=""), columns, lineterminator="\n")
            writer.writeheader()
            writer.writerows([*known, *rows])
            write_text(path, text.getvalue())
    except (OSError, UnicodeDecodeError) as error:
        refuse(f"--csv {path}", f"cannot be written ({getattr(error, 'strerror', error)}); give another file")


# -------------------------------------------------------------------------------------------------- contenders
@dataclass
class Contender:
    name: str
    command: tuple[str, ...]  # all but the size of the run
    commit: str
    torch: str  # version
    peer: bool = False
    environment: dict[str, str] = field(default_factory=dict)  # on top of this program's
    checkpoint: Path | None = None  # each run goes on from a copy of it
    first_step: int = 0  # agent steps that the checkpoint has done


def make_contenders(args: Args) -> list[Contender]:
    """Turns the command line into contenders, the scripts first. Refuses contenders that cannot be run."""
    torch, contenders = importlib.metadata.version("torch"), []
    for i, given in enumerate(args.contenders):
        try:
            script, *flags = shlex.split(given) or [""]
        except ValueError as error:
            refuse(repr(given), f"{error}; a script and its flags are read as a shell reads them")
        path = Path(script).absolute()
        if not path.is_file():
            refuse(repr(given), "no such script; give a path, with the script's flags inside the same quotes")
        for flag in flags:
            if re.match(r"--(env.id|num.envs|num.steps|total.timesteps|threads|log.dir)\b", flag):
                refuse(repr(given), f"{flag} is set here, for all contenders alike; leave it out")
        repeat = args.contenders[:i].count(given)
        command = (sys.executable, script, *flags, "--env-id", args.env_id)
        name = f"{given} ({repeat + 1})" if repeat else given
        contenders.append(Contender(name, command, commit_of(str(path), str(path.parent)), torch))
        if "--resume" in flags[:-1]:
            contenders[-1].checkpoint = Path(flags[flags.index("--resume") + 1]) / "checkpoint.pt"
            try:
                contenders[-1].first_step = in_own_process(steps_done, contenders[-1].checkpoint)
            except Exception as error:  # a file that is no checkpoint can make torch raise anything
                refuse(repr(given), f"no checkpoint can be read there ({type(error).__name__})")
    if args.peer:
        try:
            version = importlib.metadata.version("stable-baselines3")
        except importlib.metadata.PackageNotFoundError:
            refuse("--peer", "Stable-Baselines3 is not installed; pip install -e '.[peer]'")
        script = Path(__file__).resolve().parent / "sb3_ppo.py"
        command = (sys.executable, str(script), "--env-id", peer_id(args.env_id))
        contenders.append(Contender(f"Stable-Baselines3 {version}", command, commit_of(str(script)), torch, True))
    if args.cleanrl:
        script, python = args.cleanrl.resolve() / "cleanrl" / "ppo_atari.py", shutil.which(args.cleanrl_python)
        if not script.is_file():
            refuse(f"--cleanrl {args.cleanrl}", "no cleanrl/ppo_atari.py in it; give the directory of a checkout")
        ask = [python, "-c", "import importlib.metadata; print(importlib.metadata.version('torch'))"]
        if not python or not (torch := subprocess.run(ask, capture_output=True, text=True).stdout.strip()):
            refuse(f"--cleanrl-python {args.cleanrl_python}", "not an interpreter that has torch")
        # The prefix has Gymnasium import ale-py: under 0.29 the versions that ship ROMs do not register by themselves
        command = (os.path.abspath(python), str(script), "--env-id", f"ale_py:{peer_id(args.env_id)}", "--no-cuda")
        environment = {"PYTHONPATH": str(args.cleanrl.resolve())}
        commit = commit_of(str(script), str(script.parent))
        contenders.append(Contender("CleanRL", command, commit, torch, True, environment))
    return contenders


def steps_done(checkpoint: Path) -> int:
    """Returns the agent steps of a run up to its checkpoint."""
    import torch

    return torch.load(checkpoint, weights_only=True)["global_step"]


# --------------------------------------------------------------------------------------------- runs and their logs
@dataclass
class Iteration:
    end: float  # seconds since the epoch
    step: int  # agent steps so far
    phases: dict[str, float]  # seconds by tag; empty for peers


Run = dict[str, float]  # the measurements of one process, by CSV column; a peer's has no phases


@dataclass
class Row:
    """A contender at one setting."""

    contender: Contender
    num_envs: int
    threads: int
    jobs: int
    rounds: list[list[Run]] = field(default_factory=list)  # in each round, a run for each job

    @property
    def label(self) -> list[str]:
        return [self.contender.name, str(self.num_envs), str(self.threads), str(self.jobs)]

    @property
    def speeds(self) -> list[float]:
        """Steps/s of each round, its jobs together."""
        return [sum(run["steps_per_second"] for run in runs) for runs in self.rounds]

    def all(self, column: str) -> list[float]:
        """One number of every run, 0 if it has none."""
        return [run.get(column, 0.0) for runs in self.rounds for run in runs]


def read_iterations(directory: Path) -> list[Iteration]:
    """Reads the run somewhere under `directory`; an iteration ends when `charts/SPS` is logged."""
    run = next(directory.rglob("events.out.tfevents*"), directory / "none").parent
    reader = EventAccumulator(str(run), size_guidance={"scalars": 0})  # 0: every point
    reader.Reload()
    if "charts/SPS" not in (logged := reader.Tags()["scalars"]):
        return []
    phases = [tag for tag in logged if tag.startswith("time/")]
    seconds = {tag: {event.step: event.value for event in reader.Scalars(tag)} for tag in phases}
    return [
        Iteration(event.wall_time, event.step, {tag: at_step[event.step] for tag, at_step in seconds.items()})
        for event in reader.Scalars("charts/SPS")
    ]


def measure(iterations: list[Iteration], start: float, end: float) -> Run:
    """Measures the iterations between two times, from the end of the first iteration that ended there."""
    inside = [iteration for iteration in iterations if start <= iteration.end <= end]
    if len(inside) < 2:
        sys.exit("the jobs have no iteration in common after their warm-up: give a longer --window")
    seconds = [after.end - before.end for before, after in itertools.pairwise(inside)]
    run = {"steps_per_second": (inside[-1].step - inside[0].step) / sum(seconds), "time/iteration": median(seconds)}
    for tag in inside[0].phases:
        run[tag] = median(iteration.phases[tag] for iteration in inside[1:])
    if inside[0].phases:
        beyond = [total - sum(later.phases.values()) for total, later in zip(seconds, inside[1:])]
        run["time/unaccounted"] = median(beyond)
    return run


def run_process(row: Row, needed: int, directory: Path) -> tuple[list[Iteration], Run]:
    """Runs one job for `needed` iterations, and returns them with the measurements of the whole process."""
    contender, threads = row.contender, str(max(1, row.threads // row.jobs))
    command = [*contender.command, "--num-envs", str(row.num_envs)]
    command += ["--total-timesteps", str(contender.first_step + row.num_envs * NUM_STEPS * needed)]
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "", **contender.environment}
    if contender.peer:  # has no flags for these: torch reads its threads here, and `runs` is in the working directory
        environment |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads)
    else:
        command += ["--threads", threads]
        command += ["--eval-episodes", "0"] if contender.checkpoint else ["--log-dir", str(directory)]
    if contender.checkpoint:
        (directory / "run").mkdir()
        shutil.copy(contender.checkpoint, directory / "run")
        command[command.index("--resume") + 1] = str(directory / "run")
    place = {"cwd": directory if contender.peer else None, "env": environment}
    with (directory / "stderr").open("w+", encoding="utf-8", errors="replace") as stderr:
        started = time.time()
        child = subprocess.Popen(command, **place, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=stderr)
        # Peak memory of this child alone. Linux counts the memory that its parent held when it
        # started, so a run never shows less than this program holds: torch is left to the probes' own processes.
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        stderr.seek(0)
        if child.returncode != 0:
            sys.exit(f"{contender.name} ended with status {child.returncode}: {last_words(stderr.read())}")
    iterations = read_iterations(directory)
    if len(iterations) < needed:
        sys.exit(f"{contender.name} logged {len(iterations)} iterations instead of {needed}")
    kib = usage.ru_maxrss / (1024 if sys.platform == "darwin" else 1)
    return iterations[:needed], {"peak_mb": kib * 1024 / 1e6, "time/first_iteration": iterations[0].end - started}


def run_jobs(row: Row, args: Args) -> list[Run]:
    """Runs all jobs of a row at once. Their speed is measured only while all are past their warm-up and none done."""
    with tempfile.TemporaryDirectory(prefix="throughput-") as top, ThreadPoolExecutor(row.jobs) as pool:
        directories = [Path(tempfile.mkdtemp(dir=top)) for _ in range(row.jobs)]
        jobs = list(pool.map(lambda directory: run_process(row, args.warmup + args.window, directory), directories))
    start = max(iterations[args.warmup - 1].end for iterations, _ in jobs)
    end = min(iterations[-1].end for iterations, _ in jobs)
    return [{**measure(iterations, start, end), **of_process} for iterations, of_process in jobs]


def last_words(stderr: str) -> str:
    """Returns the last line, or the first in the box that tyro draws around an error."""
    box = re.search(r"^╭.*\n│(.*)│$", stderr, re.MULTILINE)
    return (box[1] if box else (stderr.strip() or "no message").splitlines()[-1]).strip()


# ------------------------------------------------------------------------------------------------------ tables
LABEL = ["contender", "envs", "threads", "jobs"]


def spread(values: list[float], digits: int = 0) -> str:
    """Median (minimum to maximum)."""
    middle, low, high = (f"{value:,.{digits}f}" for value in (median(values), min(values), max(values)))
    return f"{middle} ({low} to {high})"


def call_by_call(values: list[list[float]], digits: int = 0) -> str:
    """The spread of each call that has values: machines of one kind may differ by half, so calls have no median."""
    return "; ".join(spread(of_call, digits) for of_call in values if of_call) or "–"


def ratios(row: Row, baseline: Row) -> list[float]:
    """How many times as fast as the baseline, round by round."""
    return [speed / baseline_speed for speed, baseline_speed in zip(row.speeds, baseline.speeds)]


def speed_table(rows: list[Row]) -> str:
    """Speeds, and their ratios to the first row and to each peer at the row's own setting."""
    peers = list(dict.fromkeys(row.contender.name for row in rows if row.contender.peer))
    at = {tuple(row.label): row for row in rows}
    table = []
    for row in rows:
        baselines = [rows[0], *(at[(peer, *row.label[1:])] for peer in peers)]
        times = ["–" if row is baseline else spread(ratios(row, baseline), 2) for baseline in baselines]
        ends = [spread(row.all("peak_mb")), spread(row.all("time/first_iteration"), 1)]
        table.append([*row.label, spread(row.speeds), *times, *ends])
    ratio_names = ["× first row", *(f"× {peer}" for peer in peers)]
    return markdown([*LABEL, "steps/s", *ratio_names, "peak MB a process", "first iteration after, s"], table)


def phase_table(rows: list[Row]) -> str:
    """Milliseconds and share of an iteration: medians, so they need not add up exactly. Peers log no phases."""
    rows = [row for row in rows if not row.contender.peer]
    logged = dict.fromkeys(tag for row in rows for runs in row.rounds for run in runs for tag in run)
    tags = [*(tag for tag in logged if tag.startswith("time/") and tag not in OF_PROCESS), "time/unaccounted"]
    table = []
    for row in rows:
        iteration = row.all("time/iteration")
        columns = [row.all(tag) for tag in tags]
        shares = [median(s / total for s, total in zip(seconds, iteration)) for seconds in columns]
        cells = [f"{1000 * median(seconds):.0f} ({share:.1%})" for seconds, share in zip(columns, shares)]
        table.append([*row.label, f"{1000 * median(iteration):.0f}", *cells])
    return markdown([*LABEL, "iteration, ms", *(tag.removeprefix("time/") for tag in tags)], table)


def limits_table(rows: list[Row], limits: dict[tuple[int, int], dict[str, float]]) -> str:
    """The share of each limit that a row reaches, and the limit in agent steps/s. `in turn`: one, then the other."""
    table = []
    for row in rows:
        float32, bfloat16, emulator = limits[row.num_envs, row.threads].values()
        mflop = AGENT_STEP if row.contender.peer else AGENT_STEP + KL_PASS
        bounds = [1000 * float32 / mflop, 1000 * bfloat16 / mflop, emulator]
        bounds += [1 / (1 / bound + 1 / emulator) for bound in bounds[:2]]
        table.append([*row.label, *(f"{median(row.speeds) / bound:.0%} of {bound:,.0f}" for bound in bounds)])
    columns = ["float32 convolutions", "bfloat16 convolutions", "bare emulator"]
    return markdown([*LABEL, *columns, *(f"{column} and emulator in turn" for column in columns[:2])], table)


def columns_of(name: str, rounds: list[dict[str, dict]]) -> dict[str, list[float]]:
    """Returns the README's columns for a script: its values in the rounds (contender → row) of a call that have it."""
    columns = {"steps/s": [], "× CleanRL": [], "× Stable-Baselines3": [], "peak MB": []}
    for rows in (rows for rows in rounds if name in rows):
        speed = float(rows[name]["steps_per_second"])
        columns["steps/s"].append(speed)
        columns["peak MB"].append(float(rows[name]["peak_mb"]))
        for contender, row in rows.items():
            if (peer := f"× {contender.split(' ')[0]}") in columns:
                columns[peer].append(speed / float(row["steps_per_second"]))
    return columns


def readme_table(directory: Path = RESULTS) -> str:
    """Returns the README's table of speed: a line for each kind of processor and way to call the script.

    Calls stand side by side, without a median of all: two machines of one kind may differ by half.
    """
    table, settings = [], {}
    for path in sorted(directory.glob("throughput_*.csv")):
        calls: dict[str, dict[str, dict[str, dict]]] = {}  # call → round → contender → its row
        for row in (rows := read_csv(path)[1]):
            calls.setdefault(row.get("call"), {}).setdefault(row["round"], {})[row["contender"]] = row
        kind = rows[0].get("kind") or path.stem.removeprefix("throughput_").upper()  # older rows have none
        for name in IN_README:
            line = {"processor": f"{rows[0]['cpu']}, {kind}", "script": f"`{name}`"}
            of_calls = [columns_of(name, list(call.values())) for call in calls.values()]
            for column in of_calls[0]:
                digits = 2 if column.startswith("×") else 0
                line[column] = "; ".join(spread(call[column], digits) for call in of_calls if call[column]) or "–"
            if line["steps/s"] != "–":
                table.append(line)
                settings["{env_id}, {num_envs} environments, {threads} threads, torch {torch}".format(**rows[0])] = None
    said = f"{'; '.join(settings)}: median (minimum to maximum) over the rounds of a call; calls side by side. "
    said += "A round runs each script once; a ratio is taken within one."
    return markdown(list(table[0]), [list(line.values()) for line in table]) + f"\n{said}\n"


# ------------------------------------------------------------------------------------------------- command line
def main() -> None:
    args = parse(Args, description=__doc__)
    if args.table:
        if not write_part(ROOT / "README.md", "speed", readme_table()):
            refuse("--table", "README.md has no <!-- speed --> … <!-- end speed -->, once, to write between")
        return
    args.check()
    contenders = make_contenders(args)
    add_rows(args.csv, [])  # last, so that nothing refused above leaves a file behind
    # The contenders of one setting follow each other, so that the closest comparisons are closest in time
    settings = itertools.product(args.num_envs, args.threads, args.jobs)
    rows = [Row(contender, *setting) for setting in settings for contender in contenders]
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    cpu = (re.findall(r"model name\s*: (.*)", cpuinfo) or ["unknown processor"])[0]
    kind = in_own_process(kind_of_processor)
    call = datetime.now(timezone.utc).isoformat(timespec="milliseconds")  # its rows are compared with each other alone

    atari = find_atari_game(args.env_id)
    limits = measure_limits(atari[0], args.num_envs, args.threads) if atari else {}
    for (num_envs, threads), limit in limits.items():
        float32, bfloat16, emulator = (f"{value:,.0f}" for value in limit.values())
        tell(
            f"Limits with {threads} threads: convolutions {float32} GFLOP/s in float32 and {bfloat16} in bfloat16, "
            f"emulator {emulator} steps/s in {num_envs} environments."
        )
    for number in range(1, args.rounds + 1):
        for row in rows:
            row.rounds.append(run_jobs(row, args))
            say(f"round {number}, {' / '.join(row.label)}: {row.speeds[-1]:,.0f} steps/s")
            for job, run in enumerate(row.rounds[-1], start=1):
                date = datetime.now(timezone.utc).isoformat(timespec="seconds")
                numbers = {**run, **limits.get((row.num_envs, row.threads), {})}
                numbers = {column: f"{value:.6g}" for column, value in numbers.items()}
                identity = {"contender": row.contender.name, "date": date, "cpu": cpu, "kind": kind}
                identity |= {"call": call, "round": number, "job": job}
                # The row after the arguments: it has one value for those that have several
                record = {**vars(args), **vars(row.contender), **vars(row), **identity}
                add_rows(args.csv, [{**{name: record.get(name, "") for name in CSV_FIELDS}, **numbers}])

    versions = f"torch {contenders[0].torch}, commit {contenders[0].commit}"
    protocol = f"{args.rounds} rounds of {args.window} iterations after {args.warmup}; median (minimum to maximum)"
    tell(f"\n{args.env_id} on {cpu}, {kind}, {available_cores()} cores, {versions}; {protocol}.\n")
    tell(speed_table(rows))
    tell(phase_table(rows))
    if limits:
        tell(limits_table(rows, limits))


if __name__ == "__main__":
    main()
