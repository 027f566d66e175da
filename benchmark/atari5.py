"""The thesis's experiments: a grid of variants × games × seeds, as many runs at once as there are cores for.

    python benchmark/atari5.py --out ../again                        # the thesis's 30 runs, then their results page
    python benchmark/atari5.py --out ../again --seeds 1 --stop-at 200000  # the first 4 % of ten of them
    python benchmark/atari5.py --out ../mine --variants ppo "mine=my_ppo.py --clip-coef 0.2"  # your own script
    python benchmark/atari5.py --address auto --out /shared/results  # on the nodes of a Ray cluster

The same command again skips finished runs and resumes the others, as Ctrl-C or a dead node left them. A larger
`--stop-at` makes the same curves longer. A run that fails is resumed once, then reported, while the others train.

Each run is one process of a script, started by a Ray task (`pip install -e '.[benchmark]'`). OUT/training gets the
runs' directories, OUT/logs their output. Exit status: 0 all done, 1 some failed, 2 bad input, 130 interrupted.
"""

import ctypes
import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType

import filelock
import tyro

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the project's modules are found from any directory
import bookkeeping
from bookkeeping import NonNegativeInt, PositiveInt, StopSignal, available_cores, check_args, usage_error
from wrappers import canonical_name

ROOT = Path(__file__).resolve().parent.parent

VARIANTS = {  # a script of this project and its flags
    "ppo": "ppo_atari.py --clip-coef 0.1",  # the thesis's two, chapter 4
    "acppo": "acppo_atari.py --clip-coef 0.16 --c 1.0",
    "ppo-matched": "ppo_atari.py --clip-coef 0.084",  # adaptation or smaller steps? Its KL is nearer AC-PPO's
    "ppo-wide": "ppo_atari.py --clip-coef 0.16",  # is it the adaptation, or the width?
    "product": "acppo_atari.py --clip-coef 0.027 --c inf",  # only the product is bounded, by δ (δ by match.py)
    **{f"acppo-c{c}": f"acppo_atari.py --clip-coef 0.16 --c {c}" for c in (0.25, 0.5, 2, 4)},  # sensitivity to c ...
    **{f"acppo-eps{eps}": f"acppo_atari.py --clip-coef {eps} --c 1.0" for eps in (0.08, 0.32)},  # ... and to ε
    **{f"ppo-eps{eps}": f"ppo_atari.py --clip-coef {eps}" for eps in (0.05, 0.2)},
}
GRID_FLAGS = r"--(env.id|seed|exp.name|total.timesteps|stop.at|resume|evaluate|eval.episodes|log.dir|threads)(=|$)"
MAY_DIFFER = {"threads", "log_dir", "eval_episodes", "checkpoint_minutes", "capture_video"}
ATARI_5 = ("BattleZone", "DoubleDunk", "NameThisGame", "Phoenix", "Qbert")
LOCK_SECONDS = 120  # for which a dead node may still hold a run (NFS: 90), or the process of a dead worker


@dataclass
class Args:
    games: tuple[str, ...] = ATARI_5
    """games, or anything else that the scripts take as `--env-id`; the default is Atari-5 (chapter 4)"""
    seeds: tuple[NonNegativeInt, ...] = (1, 2, 3)
    """seeds of each variant on each game; all games of one seed come before the next"""
    variants: tuple[str, ...] = ("ppo", "acppo")
    """lines of the table VARIANTS in this file, or your own scripts as `"NAME=SCRIPT FLAGS"`"""
    total_timesteps: PositiveInt = 5_000_000
    """agent steps of each run; Atari shows 4 frames for each, so this is the thesis's 20M frames (chapter 4)"""
    stop_at: PositiveInt | None = None
    """agent steps at which each run ends for now; the schedule stays that of the whole run"""
    bf16: bool = False
    """start new runs with `--bf16`; a run that has a checkpoint keeps its arithmetic"""
    cpus_per_run: PositiveInt = 1
    """cores, and threads, of each run"""
    cores: PositiveInt = field(default_factory=available_cores)
    """cores of this machine that the grid uses, so cores / cpus_per_run runs at once"""
    out: Path = ROOT / "results"
    """directory of the results, on a path that all nodes share; the default is for the thesis's grid"""
    address: str | None = None
    """Ray cluster to run on, host:port or `auto` (the one this machine belongs to), in place of this machine's cores"""
    figures: bool = True
    """collect the results, draw the figures and write the results page once all runs are done"""
    dry_run: bool = False
    """print the commands and run nothing"""

    def rules(self) -> list[tuple[str, bool, str]]:
        """Returns (argument, does it hold, advice) for each rule that its type does not say."""
        names = [word.partition("=")[0] for word in dict.fromkeys(self.variants)]
        another = {*self.games} - {*ATARI_5} or "=" in "".join(self.variants) or self.total_timesteps != 5_000_000
        return [
            ("variants", len(names) == len(set(names)), "give each variant another name"),
            ("cpus_per_run", self.address or self.cpus_per_run <= self.cores, f"the grid has {self.cores} cores"),
            ("out", not another or self.out != Args.out, "is for the thesis's games, variants and length"),
        ]


# ------------------------------------------------------------------------------------------------- what is trained
@dataclass
class Variant:
    name: str
    script: str
    text: bytes  # of the script, when this call began
    code: str  # hash of what it does
    flags: list[str]
    arguments: dict[str, object]  # all of the script's, as these flags set them


def read_variant(word: str, total_timesteps: int) -> Variant:
    """Returns a variant of `--variants`. Ends the program with status 2 if it cannot be trained."""
    given, (name, equals, command), directory = f"--variants {word}", word.partition("="), Path.cwd()
    if not equals and name in VARIANTS:
        command, directory = VARIANTS[name], ROOT
    elif not equals or name in VARIANTS or not re.fullmatch(r"(?!.*__)\w[\w.-]{,99}", name):
        usage_error(given, f"give any of {', '.join(VARIANTS)}, or 'ANOTHER-NAME=SCRIPT FLAGS', no '__' in the name")
    try:
        script, *flags = shlex.split(command) or [""]
        text = Path(script := os.path.abspath(directory / script)).read_bytes()
        if taken := [flag for flag in flags if re.match(GRID_FLAGS, flag)]:
            raise ValueError(f"leave {', '.join(taken)} to the grid")
        sys.path.append(os.path.dirname(script))  # it may import from there
        # Without a __pycache__; dataclasses and tyro look a module up by its name
        module = sys.modules[f"variant {name}"] = ModuleType(f"variant {name}")
        module.__file__ = script
        exec(compile(text, script, "exec"), vars(module))
        grid_flags = [f"--total-timesteps={total_timesteps}", f"--exp-name={name}"]
        arguments = tyro.cli(module.Args, prog=script, args=[*flags, *grid_flags])
        check_args(arguments)
        return Variant(name, script, text, bookkeeping.code_hash(script), flags, bookkeeping.saved_args(arguments))
    except (Exception, SystemExit) as error:  # a script may raise anything; of SystemExit tyro has said the reason
        usage_error(given, f"cannot be trained ({type(error).__name__}: {error})")


@dataclass
class Run:
    """One curve. Ray's workers get it, and cannot import this project: its methods use the standard library alone."""

    name: str  # the script adds `__` and the time, for its directory
    variant: Variant
    new_flags: list[str]  # of a run without a checkpoint
    flags: list[str]  # of every start
    training: Path  # has the directories of all runs
    log: Path
    state: str = "unfinished"  # then done or failed
    step: int = 0  # agent steps in its checkpoint when this call began
    reason: str = ""  # why it failed

    def directory(self) -> Path | None:
        """Returns its newest directory that has a checkpoint: the others hold nothing to resume."""
        checkpoint = max(self.training.glob(f"{self.name}__*/checkpoint.pt"), default=None)
        return checkpoint and checkpoint.parent

    def command(self) -> list[str]:
        """Returns the command that starts or resumes it."""
        directory = self.directory()
        start = ["--resume", str(directory)] if directory else self.new_flags
        return [sys.executable, self.variant.script, *start, *self.flags]


def make_run(game: str, variant: Variant, seed: int, args: Args) -> Run:
    """Returns a run. It has failed already if its directory holds another experiment: to resume that would mix them."""
    name, training = re.sub(r"[^\w.-]", "-", f"{game}__{variant.name}__{seed}"), args.out / "training"
    new_flags = ["--env-id", game, "--seed", str(seed), "--exp-name", variant.name, "--log-dir", str(training)]
    new_flags += ["--total-timesteps", str(args.total_timesteps), *(["--bf16"] if args.bf16 else [])]
    # No evaluation: the measure is the thesis's, the last 100 games of training
    flags = ["--threads", str(args.cpus_per_run), "--eval-episodes", "0"]
    flags += [] if args.stop_at is None else ["--stop-at", str(args.stop_at)]
    run = Run(name, variant, [*variant.flags, *new_flags], flags, training, args.out / "logs" / f"{name}.log")
    if (directory := run.directory()) is None:
        return run
    try:
        import torch  # takes seconds, and only a run that was started needs it

        saved = torch.load(directory / "checkpoint.pt", map_location="cpu", weights_only=True)
        record = json.loads((directory / "args.json").read_text(encoding="utf-8"))
        trained = {**saved["args"], "script": record["provenance"]["script"]}
        wanted = {**variant.arguments, "env_id": game, "seed": seed, "script": variant.code}
        # The grid's --bf16 is for new runs, a variant's is part of it
        for name in {**trained, **wanted}.keys() - MAY_DIFFER - (set() if wanted.get("bf16") else {"bf16"}):
            if trained.get(name) != wanted.get(name):
                raise ValueError(f"it is trained with {name} {trained.get(name)}, not with {wanted.get(name)}")
        last_step = args.total_timesteps - args.total_timesteps % (trained["num_envs"] * trained["num_steps"])
        run.step = saved["global_step"]
        run.state = "done" if run.step >= min(last_step, args.stop_at or last_step) else "unfinished"
    except Exception as error:  # a file that is no checkpoint may make torch raise anything
        run.state, run.reason = "failed", f"{directory} cannot be resumed ({error}); move it away"
    return run


# --------------------------------------------------------------------------------------- in a worker process of Ray
def train(run: Run) -> str:
    """Runs a run to its end, at most twice, and returns why it failed, or nothing. Ray repeats it if this node dies."""
    # Ray's cancel interrupts by this signal, which a worker ignores if the driver does, as after `nohup … &`
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if directory := run.directory():
        with filelock.FileLock(directory / "run.lock", timeout=LOCK_SECONDS):
            pass
    # In a session that Ctrl-C in the terminal does not reach: the script would take the SIGTERM for a second signal
    prctl = getattr(ctypes.CDLL(None), "prctl", None)  # Linux has it; 1: PR_SET_PDEATHSIG, if a worker is killed
    options = {"start_new_session": True, "preexec_fn": prctl and (lambda: prctl(1, signal.SIGTERM))}
    for _ in range(2):
        if Path(run.variant.script).read_bytes() != run.variant.text:
            return f"{run.variant.script} has been edited since this call began; call again"
        with run.log.open("ab") as log:
            command = run.command()
            log.write(f"{time.strftime('%Y-%m-%d %H:%M:%S')} {os.uname().nodename}$ {shlex.join(command)}\n".encode())
            log.flush()
            child = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, **options)
        try:
            while child.poll() is None:  # not wait(): Ray's cancel raises KeyboardInterrupt only between two calls
                time.sleep(0.5)
        finally:
            if child.returncode is None:
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ray may cancel once more
                child.terminate()
                child.wait()
        if child.returncode == 0:
            return ""
    words = run.log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1]
    return f"exit status {child.returncode}: {words} (all of it in {run.log})"


# ----------------------------------------------------------------------------------------------------- the driver
def run_grid(runs: list[Run], args: Args) -> bool:
    """Takes the unfinished runs to `done` or `failed`. Returns False if a signal came; all runs are stopped then."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray

    # Nothing is stored in the object store: near the least that Ray takes
    local = {} if args.address else {"num_cpus": args.cores, "object_store_memory": 100_000_000}
    try:  # "local" even if RAY_ADDRESS is set
        ray.init(args.address or "local", logging_level="error", log_to_driver=False, include_dashboard=False, **local)
    except Exception as error:  # Ray raises bare ones, too
        usage_error(f"--address {args.address}", f"Ray does not start ({(str(error) or repr(error)).splitlines()[0]})")
    stop = StopSignal()
    stop.listen()  # after init, which has a handler for SIGTERM
    # Ray repeats a task whose worker or node died. After ten of them, it may be the run that kills them
    task = ray.remote(train).options(num_cpus=args.cpus_per_run, max_retries=10)
    pending = {task.remote(run): run for run in runs if run.state == "unfinished"}
    began, due = time.time(), time.monotonic()
    while pending and not stop.number:
        if time.monotonic() >= due:
            print(describe(runs, began), file=sys.stderr)
            due += 60
        for ref in ray.wait(list(pending), timeout=1)[0]:
            run = pending.pop(ref)
            try:
                run.reason = ray.get(ref)
            except ray.exceptions.RayError as error:
                run.reason = str(error).strip().splitlines()[-1]  # of a traceback that crossed processes
            run.state = "failed" if run.reason else "done"
    # Each task is told and awaited, because Ray kills the children of a worker that it shuts down with SIGKILL
    for ref in pending:
        ray.cancel(ref)
    ray.wait(list(pending), num_returns=len(pending))
    ray.shutdown()
    return not stop.number


def describe(runs: list[Run], began: float) -> str:
    """Returns how many runs are in which state, and the last status line of each that trains."""
    states = [run.state for run in runs]
    lines = [", ".join(f"{states.count(state)} {state}" for state in ("done", "failed", "unfinished"))]
    for run in runs:
        if run.state == "unfinished" and run.log.exists() and run.log.stat().st_mtime > began:
            said = run.log.read_text(encoding="utf-8", errors="replace").rpartition("$ ")[2]  # since its last start
            lines.append(f"  {run.name}: {(['starts'] + re.findall('step .* left', said))[-1]}")
    return "\n".join(lines)


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    args.out = args.out.resolve()  # the tasks have another working directory
    try:
        args.games = tuple(map(canonical_name, args.games))  # as in the names of directories
    except ValueError as error:
        usage_error(f"--games {' '.join(args.games)}", error)
    check_args(args)
    if len(args.seeds) == 1 and args.seeds[0] > 1:
        print(f"--seeds {args.seeds[0]}: this is one seed, number {args.seeds[0]}", file=sys.stderr)
    variants = [read_variant(word, args.total_timesteps) for word in dict.fromkeys(args.variants)]
    grid = itertools.product(dict.fromkeys(args.seeds), dict.fromkeys(args.games), variants)  # each once
    runs = [make_run(game, variant, seed, args) for seed, game, variant in grid]
    for run in runs if args.figures else ():  # now, because the report would refuse it when all are trained
        record, directory = args.out / "runs" / run.name / "run.json", run.directory()
        if record.exists() and json.loads(record.read_bytes())["source"] != (directory and directory.name):
            usage_error(f"--out {args.out}", f"{record.parent} holds a run of another training; give another directory")
    if args.dry_run:
        for run in runs:
            print(f"{run.name}: {run.reason or f'{run.state}, step {run.step:,}'}: {shlex.join(run.command())}")
        sys.exit(any(run.reason for run in runs))
    (args.out / "logs").mkdir(parents=True, exist_ok=True)
    if any(run.state == "unfinished" for run in runs) and not run_grid(runs, args):
        print(f"Stopped; resume with the same command: {shlex.join([sys.executable, *sys.argv])}", file=sys.stderr)
        sys.exit(130)
    failed = [f"{run.name}: {run.reason}" for run in runs if run.reason]
    print(*failed, f"{len(runs) - len(failed)} of {len(runs)} runs are done, in {args.out}", sep="\n", file=sys.stderr)
    if failed or not args.figures:
        sys.exit(bool(failed))
    report = [sys.executable, str(Path(__file__).with_name("report.py")), "--out", str(args.out)]
    names = [variant.name for variant in variants]
    baseline = "ppo" if "ppo" in names else names[0]
    if others := [name for name in names if name != baseline]:
        report += ["--baseline", baseline, "--challenger", *others]
    sys.exit(subprocess.run(report).returncode)


if __name__ == "__main__":
    main()
