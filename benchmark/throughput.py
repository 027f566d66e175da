"""Agent steps per second of the training scripts, of other PPOs in the same call, and of the processor itself.

    python benchmark/throughput.py ppo_atari.py acppo_atari.py
    python benchmark/throughput.py ppo_atari.py "ppo_atari.py --bf16" --peer --cleanrl ../cleanrl
    python benchmark/throughput.py ppo_atari.py --num-envs 8 16 32 64 --threads 1 2 --jobs 1 2
    python benchmark/throughput.py ppo_atari.py "ppo_atari.py --resume runs/Breakout__ppo_atari__1__1700000000"

A candidate is a script with its flags. Each run is a whole process without a GPU, and takes about a minute. Runs are
interleaved, A B A B, and compared round by round, because a machine's speed drifts; the same script given twice shows
how much noise is left. With `--jobs 2` a candidate runs as two processes that share the threads, and their steps/s add
up while both are past their warm-up. With `--resume` it runs from a copy of that checkpoint.

Three tables are printed: speed; where an iteration's time goes; and how much of two limits is reached, the convolutions
that the processor can compute and the steps that the emulator can make. The CSV gets a row for each process.
"""

import importlib.metadata
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
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the project's modules are found from any directory
from benchmark.readme import markdown
from bookkeeping import PositiveInt, available_cores, check_args, git_commit, processor_kind, usage_error, write_file
from wrappers import canonical_name, find_atari_game

ROOT = Path(__file__).resolve().parent.parent
NUM_STEPS = 128  # agent steps of each environment in an iteration (appendix A): the default of every candidate
SET_HERE = r"--(env.id|num.envs|num.steps|total.timesteps|threads|log.dir)(=|$)"  # alike for all candidates
CLEANRL = "cleanrl/ppo_atari.py"
ROW = ["candidate", "num_envs", "threads", "jobs"]  # what a row of the tables is about
LIMITS = ["float32_gflops", "bfloat16_gflops", "emulator_steps_per_second"]
# Work of the Nature CNN in MFLOP a sample, a multiplication and its addition counted as two
FIRST_LAYER = 2 * 20 * 20 * 32 * 256 / 1e6
FORWARD = FIRST_LAYER + 2 * (9 * 9 * 64 * 512 + 7 * 7 * 64 * 576 + 3136 * 512) / 1e6  # 18.7
BACKWARD = 2 * FORWARD - FIRST_LAYER  # gradients of weights and of inputs, but not of the screens
AGENT_STEP = 2 * FORWARD + 4 * (FORWARD + BACKWARD)  # 236: the rollout, the pass over it for the KL, four epochs


@dataclass
class Args:
    candidates: tyro.conf.Positional[tuple[str, ...]]
    """scripts to measure, each with its flags in one string; all are compared with the first"""
    env_id: str = "Breakout"
    """the environment, named as for the scripts; limits and peers need an Atari game"""
    rounds: PositiveInt = 3
    """times that every candidate is run"""
    warmup: PositiveInt = 3
    """iterations before the window, in which memory and caches settle"""
    window: PositiveInt = 30
    """iterations that are measured"""
    threads: tuple[PositiveInt, ...] = (available_cores(),)
    """threads of a candidate, over all its jobs; several values give a row each, as for the next two"""
    jobs: tuple[PositiveInt, ...] = (1,)
    """processes that a candidate is run as at once, with threads / jobs each, at least 1"""
    num_envs: tuple[PositiveInt, ...] = (8,)
    """environments that a process plays at once"""
    peer: bool = False
    """measure Stable-Baselines3's PPO too (`pip install -e '.[peer]'`)"""
    cleanrl: Path | None = None
    """measure cleanrl/ppo_atari.py of this checkout of CleanRL too"""
    cleanrl_python: str = sys.executable
    """its interpreter: torch, gymnasium 0.29.1, ale-py 0.10.1, numpy 1, opencv-python-headless 4, tensorboard, tyro"""
    csv: Path = ROOT / "results" / "throughput.csv"
    """file that the rows are added to"""

    def rules(self) -> list[tuple[str, bool, str]]:
        """Returns (argument, does it hold, advice) for each rule that its type does not say."""
        _, sticky = find_atari_game(self.env_id) or ("", 1.0)
        return [
            ("candidates", bool(self.candidates), "name a script, for example ppo_atari.py"),
            ("env_id", not sticky or not (self.peer or self.cleanrl), "peers need a game such as Breakout"),
            ("cleanrl", not self.cleanrl or (self.cleanrl / CLEANRL).is_file(), f"there is no {CLEANRL} in it"),
        ]


@dataclass
class Candidate:
    name: str
    command: list[str]  # all but the size of the run
    commit: str
    torch: str  # version
    peer: bool = False  # another project's PPO
    variables: dict[str, str] = field(default_factory=dict)  # of its environment
    checkpoint: Path | None = None  # each run resumes a copy of it
    first_step: int = 0  # agent steps in the checkpoint


def make_candidates(args: Args) -> list[Candidate]:
    """Returns what the command line names, the scripts first. Ends the program with status 2 if one cannot run."""
    version, candidates = importlib.metadata.version("torch"), []
    for i, given in enumerate(args.candidates):
        script, *flags = shlex.split(given)
        if not Path(script).is_file():
            usage_error(repr(given), "no such script; give a path, with the script's flags inside the same quotes")
        if taken := [flag for flag in flags if re.match(SET_HERE, flag)]:
            usage_error(repr(given), f"leave out {' '.join(taken)}, which is the same for all candidates")
        name = f"{given} ({args.candidates[:i].count(given) + 1})" if given in args.candidates[:i] else given
        script = os.path.abspath(script)
        command = [sys.executable, script, *flags, "--env-id", args.env_id, "--eval-episodes", "0"]
        candidates.append(Candidate(name, command, git_commit(script, os.path.dirname(script)), version))
        if "--resume" in flags:
            import torch

            place = command.index("--resume")
            checkpoint = candidates[-1].checkpoint = Path(command[place + 1]) / "checkpoint.pt"
            candidates[-1].first_step = torch.load(checkpoint, weights_only=True)["global_step"]
            del command[place : place + 2]
    game = f"{canonical_name(args.env_id)}NoFrameskip-v4"  # as peers name it
    if args.peer:
        name = f"Stable-Baselines3 {importlib.metadata.version('stable-baselines3')}"
        command = [sys.executable, str(Path(__file__).with_name("sb3_ppo.py")), "--env-id", game]
        candidates.append(Candidate(name, command, git_commit(__file__), version, peer=True))
    if args.cleanrl:
        checkout, python = str(args.cleanrl.resolve()), args.cleanrl_python
        ask = [python, "-c", "import importlib.metadata; print(importlib.metadata.version('torch'))"]
        version = subprocess.run(ask, check=True, capture_output=True, text=True).stdout.strip()
        # The prefix has Gymnasium import ale-py: under 0.29 the versions that ship ROMs do not register by themselves
        python, script = os.path.abspath(shutil.which(python)), f"{checkout}/{CLEANRL}"
        command, commit = [python, script, "--env-id", f"ale_py:{game}", "--no-cuda"], git_commit(script, checkout)
        candidates.append(Candidate("CleanRL", command, commit, version, True, {"PYTHONPATH": checkout}))
    return candidates


# ------------------------------------------------------------------------------------------ limits of the processor
def probe_convolutions(threads: int, dtype_name: str, seconds: float = 2.0) -> float:
    """Returns the best GFLOP/s of the network's three convolutions, forward and backward on 256 samples."""
    import torch

    torch.set_num_threads(threads)
    layout = {"dtype": getattr(torch, dtype_name), "memory_format": torch.channels_last}
    layers = [torch.nn.Conv2d(*sizes) for sizes in ((4, 32, 8, 4), (32, 64, 4, 2), (64, 64, 3, 1))]
    network, screens = torch.nn.Sequential(*layers).to(**layout), torch.rand(256, 4, 84, 84).to(**layout)
    forward, best, stop = FORWARD - 2 * 3136 * 512 / 1e6, 0.0, time.perf_counter() + seconds
    while not best or time.perf_counter() < stop:
        start = time.perf_counter()
        output = network(screens)
        output.backward(output.detach())
        best = max(best, len(screens) * (3 * forward - FIRST_LAYER) / 1e3 / (time.perf_counter() - start))
    return best


def probe_emulator(rom: str, num_envs: int, threads: int, block: int = 100) -> float:
    """Returns the best steps/s of the emulator over blocks of steps: random actions, the network's screens."""
    from ale_py.vector_env import AtariVectorEnv

    envs, best = AtariVectorEnv(rom, num_envs, num_threads=threads, use_fire_reset=False), 0.0
    envs.reset(seed=1)
    actions = np.random.default_rng(1).integers(envs.single_action_space.n, size=(20, block, num_envs))
    for of_block in actions:
        start = time.perf_counter()
        for of_step in of_block:
            envs.step(of_step)
        best = max(best, of_block.size / (time.perf_counter() - start))
    return best


# ------------------------------------------------------------------------------------------------ processes and logs
def read_log(directory: Path) -> pd.DataFrame:
    """Reads the run somewhere under a directory: a row an iteration, which ends when `charts/SPS` is logged."""
    (file,) = directory.rglob("events.out.tfevents*")
    reader = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()  # 0: every point
    tags = [tag for tag in reader.Tags()["scalars"] if tag.startswith("time/")]  # the phases; peers log none
    columns = {tag: {event.step: event.value for event in reader.Scalars(tag)} for tag in tags}
    columns["end"] = {event.step: event.wall_time for event in reader.Scalars("charts/SPS")}
    return pd.DataFrame(columns).rename_axis("step").reset_index()


def measure(log: pd.DataFrame, start: float, end: float) -> dict[str, float]:
    """Measures the iterations between two times, from the end of the first iteration that ended there."""
    log = log[log["end"].between(start, end)]
    if len(log) < 2:
        sys.exit("the jobs have no iteration in common after their warm-up: give a longer --window")
    seconds, phases = log["end"].diff()[1:], log.filter(like="time/")[1:]
    speed = np.ptp(log["step"]) / seconds.sum()
    return {"steps_per_second": speed, "time/iteration": seconds.median(), **phases.median()}


def run_process(setting: dict, iterations: int) -> tuple[pd.DataFrame, float]:
    """Runs one job; returns its log, and the most MB that its process held."""
    candidate, num_envs, threads, jobs = setting.values()
    last_step = candidate.first_step + num_envs * NUM_STEPS * iterations
    command = [*candidate.command, "--num-envs", str(num_envs), "--total-timesteps", str(last_step)]
    variables, threads = {**os.environ, "CUDA_VISIBLE_DEVICES": "", **candidate.variables}, str(max(1, threads // jobs))
    with tempfile.TemporaryDirectory(prefix="throughput-") as directory:
        if candidate.peer:  # it has no flag for threads, and logs below its working directory
            variables |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), threads)
        else:
            command += ["--threads", threads, "--log-dir", directory]
        if candidate.checkpoint:
            command += ["--resume", shutil.copy(candidate.checkpoint, directory)]
        cwd = directory if candidate.peer else None
        child = subprocess.Popen(command, cwd=cwd, env=variables, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        if child.returncode != 0:
            sys.exit(f"{candidate.name} ended with status {child.returncode}")
        # At least what this program holds, as Linux counts it: so the probes are other processes
        return read_log(Path(directory)), usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024) / 1e6


def run_jobs(setting: dict, args: Args) -> list[dict[str, float]]:
    """Runs all jobs at once. Their speed is measured only while all are past their warm-up and none is done."""
    with ThreadPoolExecutor(setting["jobs"]) as pool:
        calls = [pool.submit(run_process, setting, args.warmup + args.window) for _ in range(setting["jobs"])]
    jobs = [call.result() for call in calls]
    start = max(log["end"].iloc[args.warmup - 1] for log, _ in jobs)
    end = min(log["end"].iloc[-1] for log, _ in jobs)
    return [{**measure(log, start, end), "peak_mb": peak_mb} for log, peak_mb in jobs]


def add_rows(path: Path, rows: list[dict[str, object]]) -> None:
    """Adds rows to a CSV, and columns that it has not had; cells without a value stay empty."""
    tables = [*([pd.read_csv(path)] if path.exists() else []), pd.DataFrame(rows)]
    write_file(path, pd.concat(tables).to_csv(index=False, float_format="%.6g", lineterminator="\n"))


# ------------------------------------------------------------------------------------------------------ tables
def spread(values: pd.Series, digits: int = 0) -> str:
    """Returns median (minimum to maximum)."""
    return "{:,.{n}f} ({:,.{n}f} to {:,.{n}f})".format(values.median(), values.min(), values.max(), n=digits)


def make_tables(processes: pd.DataFrame, peers: list[str]) -> list[str]:
    """Returns the tables of speed, phases and limits.

    Speeds are compared with the first row, and with each peer at the same setting. Phases are milliseconds and shares
    of an iteration: medians, which need not add up. Limits are shares, and what these are of. Both are the scripts'.
    """
    speeds = processes.groupby([*ROW, "round"], sort=False)["steps_per_second"].sum().unstack()  # all jobs together
    phases = processes.filter(like="time/").columns.drop("time/iteration")
    speed_table, phase_table, limits_table = [], [], []
    for row, own in processes.groupby(ROW, sort=False):
        speed, label, iteration = speeds.loc[row], [*map(str, row)], own["time/iteration"]
        others = [tuple(processes[ROW].iloc[0]), *((peer, *row[1:]) for peer in peers)]
        ratios = ["–" if row == other else spread(speed / speeds.loc[other], 2) for other in others]
        speed_table.append([*label, spread(speed), *ratios, spread(own["peak_mb"])])
        if row[0] in peers:
            continue
        shares = own[phases].div(iteration, axis=0).median()
        cells = [f"{1000 * own[phase].median():.0f} ({shares[phase]:.1%})" for phase in phases]
        phase_table.append([*label, f"{1000 * iteration.median():.0f}", *cells])
        if LIMITS[0] in own:
            *gflops, emulator = own[LIMITS].iloc[0]
            network = [1000 * limit / AGENT_STEP for limit in gflops]
            limits = [*network, emulator, *(1 / (1 / limit + 1 / emulator) for limit in network)]
            limits_table.append([*label, *(f"{speed.median() / limit:.0%} of {limit:,.0f}" for limit in limits)])
    speed_names = ["steps/s", "× first row", *(f"× {peer}" for peer in peers), "peak MB a process"]
    phase_names = ["iteration, ms", *phases.str.removeprefix("time/")]
    bounds = ["float32 convolutions", "bfloat16 convolutions", "bare emulator"]
    bounds += [f"{bound} and emulator in turn" for bound in bounds[:2]]
    tables = [(speed_names, speed_table), (phase_names, phase_table), (bounds, limits_table)]
    return [markdown([*ROW, *names], table) for names, table in tables if table]


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    check_args(args)
    candidates = make_candidates(args)
    args.csv.parent.mkdir(parents=True, exist_ok=True)
    # The candidates of one setting follow each other, so that the closest comparisons are closest in time
    products = itertools.product(args.num_envs, args.threads, args.jobs, candidates)
    settings = [dict(zip(ROW, (candidate, *numbers))) for *numbers, candidate in products]
    cpuinfo = Path("/proc/cpuinfo").read_text(encoding="utf-8") if sys.platform == "linux" else ""
    cpu = (re.findall(r"model name\s*: (.*)", cpuinfo) or ["unknown processor"])[0]
    call = {"call": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()), "env_id": args.env_id, "cpu": cpu}
    rom, _ = find_atari_game(args.env_id) or ("", 0.0)
    limits, processes = {}, []
    # A process each: a probe sets torch's threads, and its memory is not to count as this program's
    with get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
        call |= {"kind": pool.apply(processor_kind), "warmup": args.warmup, "window": args.window}
        for num_envs, threads in itertools.product(args.num_envs, args.threads) if rom else ():
            gflops = [pool.apply(probe_convolutions, (threads, dtype)) for dtype in ("float32", "bfloat16")]
            limits[num_envs, threads] = [*gflops, pool.apply(probe_emulator, (rom, num_envs, threads))]
    for number, setting in itertools.product(range(1, args.rounds + 1), settings):
        candidate = setting["candidate"]
        about = {**call, "commit": candidate.commit, "torch": candidate.torch, **setting, "candidate": candidate.name}
        about |= {"round": number, **dict(zip(LIMITS, limits.get((setting["num_envs"], setting["threads"]), ())))}
        rows = [{**about, **job} for job in run_jobs(setting, args)]
        add_rows(args.csv, rows)
        processes += rows
        speed = sum(row["steps_per_second"] for row in rows)
        print(f"round {number}, {' / '.join(str(about[name]) for name in ROW)}: {speed:,.0f} steps/s", file=sys.stderr)

    tables = make_tables(pd.DataFrame(processes), [candidate.name for candidate in candidates if candidate.peer])
    machine = f"{cpu}, {call['kind']}, {available_cores()} cores, torch {candidates[0].torch}"
    window = f"{args.rounds} rounds of {args.window} iterations after {args.warmup}"
    print(f"{args.env_id} on {machine}; {window}; median (minimum to maximum).\n", *tables, sep="\n")


if __name__ == "__main__":
    main()
