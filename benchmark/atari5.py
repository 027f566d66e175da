"""The thesis's experiments: a grid of variants × games × seeds, as many runs at once as there are cores for.

    python benchmark/atari5.py                                       # the thesis's 30 runs, then its figures
    python benchmark/atari5.py --seeds 1 --stop-at 200000            # the first 4 % of ten of them
    python benchmark/atari5.py --out ../mine --variants ppo "mine=my_ppo.py --clip-coef 0.2"  # a script of one's own
    python benchmark/atari5.py --address auto --out /shared/results  # on the nodes of a Ray cluster

The same command again goes on: finished runs are skipped, others are resumed from their checkpoints. A run that fails
is resumed once, then reported, and the rest goes on; the runs of a node that dies go on elsewhere; Ctrl-C leaves every
run resumable. With a larger `--stop-at` the same curves become longer.

Each run is one process of a script, started by a Ray task (`pip install -e '.[benchmark]'`). OUT/runs gets the runs'
own directories, OUT/logs what each of them was started with and has printed. Exit status: 0 all done, 1 some failed,
2 bad input, 130 interrupted.
"""

import contextlib
import ctypes
import hashlib
import importlib.util
import io
import itertools
import json
import logging
import math
import os
import platform
import re
import shlex
import signal
import socket
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from types import ModuleType

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import RETIRED, StopSignal, available_cores, parse, refuse, say, tell
from bookkeeping import check as check_bounds

SCRIPTS = Path(__file__).resolve().parent.parent
# A script of this directory and its flags; a variant of one's own is given as NAME=SCRIPT FLAGS
VARIANTS = {
    "ppo": "ppo_atari.py --clip-coef 0.1",  # the thesis's two, chapter 4
    "acppo": "acppo_atari.py --clip-coef 0.16 --c 1.0",
    # Is it the adaptation, or only smaller steps? Its KL over a whole run of Qbert is to be AC-PPO's (README.md here)
    "ppo-matched": "ppo_atari.py --clip-coef 0.084",
    "ppo-wide": "ppo_atari.py --clip-coef 0.16",  # is it the adaptation, or the width?
    "product": "acppo_atari.py --clip-coef 0.027 --c inf",  # the product alone; δ by match.py
    "acppo-c0.25": "acppo_atari.py --clip-coef 0.16 --c 0.25",  # sensitivity to c ...
    "acppo-c0.5": "acppo_atari.py --clip-coef 0.16 --c 0.5",
    "acppo-c2": "acppo_atari.py --clip-coef 0.16 --c 2.0",
    "acppo-c4": "acppo_atari.py --clip-coef 0.16 --c 4.0",
    "acppo-eps0.08": "acppo_atari.py --clip-coef 0.08 --c 1.0",  # ... and to ε, beside PPO's
    "acppo-eps0.32": "acppo_atari.py --clip-coef 0.32 --c 1.0",
    "ppo-eps0.05": "ppo_atari.py --clip-coef 0.05",
    "ppo-eps0.2": "ppo_atari.py --clip-coef 0.2",
}
# The grid gives these, so a variant cannot
OF_THE_GRID = "--env-id --seed --exp-name --total-timesteps --stop-at --resume --evaluate --eval-episodes".split()
OF_THE_GRID += "--log-dir --threads --help -h".split()
# A run with others of these arguments is the same experiment
NOT_COMPARED = {"threads", "log_dir", "eval_episodes", "checkpoint_minutes", "capture_video", *RETIRED}
ATARI_5 = ("BattleZone", "DoubleDunk", "NameThisGame", "Phoenix", "Qbert")
COMMON_FLAGS = ["--eval-episodes", "0"]  # the measure is the thesis's, the last 100 games of training
# For the process of a dead task to end, with its iteration and its checkpoint, or a file server to notice its node's
# death (NFS: 90 s)
LOCK_SECONDS = 120
MOST_DEATHS = 10  # of the workers and nodes of one run; more, and it may be the run that kills them
SILENCE_SECONDS = 300  # in which a running script has said something, as it does each minute
PROGRESS = re.compile(r"step ([\d,]+) of [\d,]+, (\d+) SPS(?:, score (-?[\d.]+))?")  # a script says this each minute


@dataclass
class Args:
    games: tuple[str, ...] = ATARI_5
    """games, or anything else that the scripts take as `--env-id`; the default is Atari-5 (chapter 4)"""
    seeds: tuple[int, ...] = (1, 2, 3)
    """seeds of each variant on each game; all games of one seed come before the next"""
    variants: tuple[str, ...] = ("ppo", "acppo")
    """lines of the table VARIANTS in this file, or scripts of one's own as `"NAME=SCRIPT FLAGS"`"""
    total_timesteps: int = 5_000_000
    """agent steps of each run; Atari shows 4 frames for each, so this is the thesis's 20M frames (chapter 4)"""
    stop_at: int | None = None
    """agent steps at which each run ends for now; the schedule stays that of the whole run"""
    bf16: bool = False
    """start new runs with `--bf16`; a run that has a checkpoint goes on as it began"""
    cpus_per_run: int = 1
    """cores, and threads, of each run"""
    cores: int | None = None
    """cores of this machine that the grid uses, so cores / cpus_per_run runs at once; by default all that this process
    may use. A cluster knows its own"""
    out: Path = Path(__file__).resolve().parent / "results"
    """directory for everything that comes of the grid; with `--address`, on a path that all nodes share. The default
    is for the thesis's games, variants and length alone"""
    address: str | None = None
    """Ray cluster to run on, host:port or `auto` (the one this machine belongs to), not the cores of this process"""
    figures: bool = True
    """draw the figures once all runs are done"""
    dry_run: bool = False
    """print the commands and run nothing"""


# Not a method: methods of Args and Run travel to Ray's workers, which may not find bookkeeping.py
def check(args: Args) -> None:
    """Ends the program with status 2 at the first argument that cannot work."""
    for name in ("games", "seeds", "variants"):
        if not getattr(args, name):
            refuse(f"--{name}", "give at least one")
    names = [word.partition("=")[0] for word in dict.fromkeys(args.variants)]
    if len(names) > len(set(names)):
        refuse(f"--variants {' '.join(args.variants)}", "give each variant a name of its own")
    for game in args.games:
        if not re.fullmatch(r"\w[\w./:-]{,100}", game):
            refuse(f"--games {game!r}", "give names such as Phoenix, apart from each other")
    if not all(0 <= seed < 2**64 for seed in args.seeds):
        refuse(f"--seeds {' '.join(map(str, args.seeds))}", "give whole numbers from 0 to 2^64 - 1")
    for name in ("total_timesteps", "stop_at", "cpus_per_run", "cores"):
        if (given := getattr(args, name)) is not None and given < 1:
            refuse(f"--{name.replace('_', '-')} {given}", "give a whole number above 0")
    if args.cores is not None and args.address is not None:
        refuse(f"--cores {args.cores}", "is for this machine alone; leave it out beside --address")
    cores = args.cores or available_cores()
    if args.address is None and args.cpus_per_run > cores:
        refuse(f"--cpus-per-run {args.cpus_per_run}", f"the grid has {cores} cores")
    for package in ("ray", "matplotlib", "pandas"):
        if importlib.util.find_spec(package) is None:
            refuse(package, "is not installed; pip install -e '.[benchmark]'")
    another = not set(args.games) <= set(ATARI_5) or args.total_timesteps != Args.total_timesteps
    if args.out == Args.out and (another or "=" in "".join(args.variants)):
        refuse(f"--out {args.out}", "is for the thesis's games, variants and length; give another directory")
    if args.address not in (None, "auto"):  # Ray itself would knock for minutes
        host, _, port = args.address.rpartition(":")
        try:
            socket.create_connection((host, int(port)), timeout=5).close()
        except (OSError, ValueError, OverflowError):
            refuse(f"--address {args.address}", "no Ray cluster answers there; give host:port, or auto")


# ------------------------------------------------------------------------------------------------- what is trained
@dataclass
class Variant:
    name: str
    script: str  # its path from the root
    flags: list[str]
    text: bytes  # of the script, when this call began
    arguments: dict[str, object]  # all of the script's, as these flags set them


def read_variant(word: str, total_timesteps: int) -> Variant:
    """Returns a variant of `--variants`. Ends the program with status 2 if it cannot be trained."""
    given, (name, own, command), here = f"--variants {word}", word.partition("="), Path.cwd()
    if not own and name in VARIANTS:
        command, here = VARIANTS[name], SCRIPTS
    elif not own or name in VARIANTS or not re.fullmatch(r"(?!.*__)\w[\w.-]{,99}", name):
        refuse(given, f"give any of {', '.join(VARIANTS)}, or 'ANOTHER-NAME=SCRIPT FLAGS', with no '__' in the name")
    try:
        script, *flags = shlex.split(command) or [""]
        text = Path(script := os.path.abspath(here / script)).read_bytes()
    except (ValueError, OSError) as error:
        refuse(given, f"cannot be read ({error})")
    for flag in flags:
        if flag.partition("=")[0].replace("_", "-") in OF_THE_GRID:
            refuse(given, f"leave {flag} to the grid")
    # Imported as the text that was read, and without a trace beside it; dataclasses look it up by its name
    module = sys.modules[f"variant {name}"] = ModuleType(f"variant {name}")
    module.__file__ = script
    sys.path.append(os.path.dirname(script))  # for what it imports from there
    try:
        with contextlib.redirect_stderr(io.StringIO()) as said:
            exec(compile(text, script, "exec"), vars(module))
            common = f"--total-timesteps {total_timesteps} --exp-name {name} --log-dir . --threads 1".split()
            arguments = parse(module.Args, args=[*flags, *common, *COMMON_FLAGS])
    except (Exception, SystemExit) as error:  # a script may raise anything
        # tyro says why between two rules, and more around them
        kind, said = type(error).__name__, re.sub("[│╭╮╰╯]", "", said.getvalue())
        reason = re.split("[-─]{9,}", said)[1:2] or [f"{kind}: {error}"]
        refuse(given, f"{script} cannot be used ({reason[0].strip()})")
    try:
        check_bounds(arguments)
        return Variant(name, script, flags, text, vars(arguments))
    except Exception as error:  # its Args may have no rules(), or rules that raise
        refuse(given, f"{script} cannot be used ({type(error).__name__}: {error})")


@dataclass
class Run:
    game: str
    variant: Variant
    seed: int
    state: str = "queued"  # then running, done or failed
    step: int = 0  # agent steps in its checkpoint when this call began
    log_size: int = 0  # bytes, then
    reason: str = ""  # that it failed for

    @property
    def name(self) -> str:
        """What its directories' names begin with; the script adds `__` and the time."""
        game = re.sub(r"[^\w.-]", "-", self.game)
        return f"{game}__{self.variant.name}__{self.seed}"

    def log(self, args: Args) -> Path:
        return args.out / "logs" / f"{self.name}.log"

    def checkpoint(self, args: Args) -> Path | None:
        """Returns the checkpoint of its newest directory that has one: the others hold nothing to resume."""
        return max((args.out / "runs").glob(f"{self.name}__*/checkpoint.pt"), default=None)

    def command(self, args: Args) -> list[str]:
        """Returns the command that starts it, or takes it further."""
        if checkpoint := self.checkpoint(args):
            flags, which = [], {"resume": checkpoint.parent}
        else:
            flags, which = self.variant.flags, {"env_id": self.game, "seed": self.seed, "exp_name": self.variant.name}
            which |= {"log_dir": args.out / "runs", "total_timesteps": args.total_timesteps}
        which["threads"] = args.cpus_per_run
        if args.stop_at is not None:
            which["stop_at"] = args.stop_at
        words = [word for name, value in which.items() for word in (f"--{name.replace('_', '-')}", str(value))]
        bf16 = ["--bf16"] if args.bf16 and not checkpoint else []
        return [sys.executable, self.variant.script, *flags, *words, *bf16, *COMMON_FLAGS]

    def look(self, args: Args) -> None:
        """Finds out how far it is, and whether its checkpoint is this run's: going on with another would mix two."""
        self.log_size = self.log(args).stat().st_size if self.log(args).exists() else 0
        if (checkpoint := self.checkpoint(args)) is None:
            return
        import torch  # takes seconds, so only if there is something to read

        try:
            saved = torch.load(checkpoint, map_location="cpu", weights_only=True)
            trained, self.step = saved["args"], saved["global_step"]
            rollout = trained["num_envs"] * trained["num_steps"]
        except Exception:  # a file that is no checkpoint may make them raise anything
            self.state, self.reason = "failed", f"{checkpoint} is damaged; move its directory away"
            return
        wanted = {**self.variant.arguments, "env_id": self.game, "seed": self.seed}
        # The grid's --bf16 is for new runs alone; a variant's own is part of it
        ignored = NOT_COMPARED if wanted.get("bf16") else {*NOT_COMPARED, "bf16"}
        differences = [
            f"with --{name.replace('_', '-')} {trained.get(name)}, not with {wanted.get(name)}"
            for name in {**trained, **wanted}
            if name not in ignored and trained.get(name) != wanted.get(name)
        ]
        # A run of an older commit has no hash, so its arguments alone are compared
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            record = json.loads((checkpoint.parent / "args.json").read_text(encoding="utf-8"))
            if record["provenance"]["script"] != f"sha256 {hashlib.sha256(self.variant.text).hexdigest()}":
                differences.append(f"by another text of {Path(self.variant.script).name}")
        if differences:
            advice = "move it away, or give another --out (no figures are drawn beside it)"
            self.state, self.reason = "failed", f"{checkpoint.parent} is trained {differences[0]}; {advice}"
            return
        if self.step >= min(args.total_timesteps // rollout * rollout, args.stop_at or math.inf):
            self.state = "done"


def tail(log: Path, after: int = 0) -> str:
    """Returns the last 4 kB of a log, from `after` bytes on; nothing if there is none yet."""
    try:
        with log.open("rb") as file:
            file.seek(max(after, file.seek(0, os.SEEK_END) - 4096))
            return file.read().decode(errors="replace")
    except OSError:
        return ""


# --------------------------------------------------------------------------------------- in a worker process of Ray
def train(run: Run, args: Args, omp_num_threads: str | None) -> str:
    """Runs a run to its end, at most twice, and returns why it failed, or nothing. Ray calls it once more, on another
    node, if this one has died.

    The lock on the log keeps two processes off one run. It belongs to the open file, which the script inherits as its
    output: it lasts until the task and the script are gone, whichever of them lives longer.
    """
    import fcntl  # POSIX alone has it, and the rest of this file does without

    # Ray's cancel interrupts by this signal, which a worker ignores if the driver does, as under `nohup … &`
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # Ray sets this for its workers; a run shall see the same as without Ray
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    if omp_num_threads is not None:
        environment["OMP_NUM_THREADS"] = omp_num_threads
    with run.log(args).open("ab") as log:
        deadline = time.monotonic() + LOCK_SECONDS
        while True:
            try:
                fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    return "another process is training it; call again when it has ended"
                time.sleep(0.5)  # not a blocking flock: Ray's cancel could not end that
        for _ in range(2):
            if Path(run.variant.script).read_bytes() != run.variant.text:
                return f"{run.variant.script} has been edited since this call began; call again"
            command = run.command(args)  # now that the lock is held, and the checkpoint is whole
            log.write(os.fsencode(f"{datetime.now():%Y-%m-%d %H:%M:%S} {platform.node()}$ {shlex.join(command)}\n"))
            log.flush()
            if (status := run_process(command, environment, log)) == 0:
                return ""
    words = [line for line in tail(run.log(args)).splitlines() if re.search(r"\w", line)][-1].strip(" │")
    return f"exit status {status}: {words} (all of it in {run.log(args)})"


def run_process(command: list[str], environment: dict[str, str], log) -> int:
    """Runs a process that does not outlive this one, and returns its exit status."""
    worker, libc = os.getpid(), ctypes.CDLL(None) if sys.platform == "linux" else None

    def die_with_worker() -> None:
        # For a worker that is killed: one that ends by itself kills its children. SIGTERM has the script write a
        # checkpoint, and the lock has the next attempt wait for it. 1 is PR_SET_PDEATHSIG, which Linux alone has.
        if libc is not None:
            libc.prctl(1, signal.SIGTERM)
        if os.getppid() != worker:  # it died before the line above
            os._exit(1)

    # In a session of its own, so that Ctrl-C in the terminal reaches the driver alone: a script that got that and the
    # SIGTERM below would take the second for "at once", and write no checkpoint
    own = {"start_new_session": True, "preexec_fn": die_with_worker}
    child = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log, **own)
    try:
        while child.poll() is None:  # not wait(): Ray's cancel raises KeyboardInterrupt only between two calls
            time.sleep(0.5)
    finally:
        if child.returncode is None:
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ray may cancel once more
            child.terminate()
            child.wait()
    return child.returncode


# ----------------------------------------------------------------------------------------------------- the driver
class Interrupt(StopSignal):
    """Raises KeyboardInterrupt at a signal, and again at one that comes a second or more after it."""

    def note(self, number: int, frame: object) -> None:
        if not self.number or time.monotonic() - self.since >= 1:
            self.number, self.since = number, time.monotonic()
            raise KeyboardInterrupt


def run_grid(runs: list[Run], args: Args) -> None:
    """Takes the queued runs to `done` or `failed`. Raises KeyboardInterrupt when interrupted, with all runs stopped."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    import ray

    quiet = {"logging_level": logging.ERROR, "log_to_driver": False}
    # "local" even if RAY_ADDRESS is set. Nothing is stored in the object store: near the least that Ray takes.
    cores = {"num_cpus": args.cores or available_cores(), "object_store_memory": 100_000_000}
    cores["include_dashboard"] = False
    pending, interrupt = {}, Interrupt()
    try:
        try:
            ray.init(args.address or "local", **quiet, **({} if args.address else cores))
        except Exception as error:  # Ray raises bare ones, too
            reason = (str(error) or repr(error)).splitlines()[0]
            advice = "" if args.address else "; set RAY_TMPDIR or TMPDIR to a short path that can be written"
            refuse(f"--address {args.address or 'local'}", f"Ray does not start ({reason}){advice}")
        interrupt.listen()  # after init, which has a handler for SIGTERM
        most = max(node["Resources"].get("CPU", 0) for node in ray.nodes() if node["Alive"])
        if args.cpus_per_run > most:
            refuse(f"--cpus-per-run {args.cpus_per_run}", f"no node has more than {most:.0f}")
        task = ray.remote(train).options(num_cpus=args.cpus_per_run, max_retries=MOST_DEATHS)
        omp = os.environ.get("OMP_NUM_THREADS")
        for run in runs:
            if run.state == "queued":
                pending[task.remote(run, args, omp)] = run
        progress = Progress(runs, args)
        while pending:
            progress.show()
            for ref in ray.wait(list(pending), timeout=1)[0]:
                run = pending.pop(ref)
                try:
                    run.reason = ray.get(ref)
                except ray.exceptions.RayError as error:
                    run.reason = str(error).strip().splitlines()[-1]  # of a traceback that crossed processes
                run.state = "failed" if run.reason else "done"
        progress.show()
    except KeyboardInterrupt:
        # Each task is told and awaited, because Ray kills the children of a worker that it shuts down with SIGKILL
        if pending:
            say("\nStopping: each run writes a checkpoint; another signal, at least a second from now, ends at once")
            interrupt.listen()  # serves the second of two signals now; Ray looks for it once a second
            for ref in pending:
                ray.cancel(ref)
            while ray.wait(list(pending), num_returns=len(pending), timeout=0.1)[1]:
                pass
        raise
    finally:
        ray.shutdown()


class Progress:
    """Shows how far the grid is on standard error: a table that updates in a terminal, a line a minute in a log."""

    def __init__(self, runs: list[Run], args: Args):
        self.runs, self.args = runs, args
        self.drawn = 0  # lines of the table on the screen
        self.due = time.monotonic() + 60

    def show(self) -> None:
        if not (terminal := os.isatty(2)) and time.monotonic() < self.due:
            return
        self.due, table = time.monotonic() + 60, self.table()
        if terminal:
            back = f"\x1b[{self.drawn}F\x1b[J" if self.drawn else ""  # up to the table's first line, and clear
            with contextlib.suppress(OSError):  # lines that wrap or scroll away cannot be written over
                columns, lines = os.get_terminal_size(2)  # 0 if it does not tell
                table = [line[: (columns or 80) - 1] for line in table[: (lines or 24) - 1]]
            say(back + "\n".join(table))
            self.drawn = len(table)
        else:
            say("; ".join(" ".join(line.split()) for line in table))

    def table(self) -> list[str]:
        """Returns a line on the grid, and one for each run that is running or has failed."""
        goal = min(self.args.total_timesteps, self.args.stop_at or math.inf)
        rows, steps_left, speed = [], 0, 0
        for run in self.runs:
            name = f"{run.game:15} {run.variant.name:14} seed {run.seed}"
            if run.state == "failed":
                rows.append(f"{name}  failed")
            if run.state not in ("queued", "running"):
                continue
            step, score, log = run.step, "", run.log(self.args)
            written = tail(log, after=run.log_size)  # in this call; its task writes first
            run.state = "queued"  # or so again, when its node has died
            if written and time.time() - log.stat().st_mtime < SILENCE_SECONDS:
                run.state = "running"
                if said := PROGRESS.findall(written):
                    step, sps, score = said[-1]
                    step, speed = int(step.replace(",", "")), speed + int(sps)
                rows.append(f"{name} {min(1, step / goal):5.0%}" + (f"  score {score}" if score else ""))
            steps_left += max(0, goal - step)
        states = [run.state for run in self.runs]
        counts = ", ".join(f"{states.count(state)} {state}" for state in ("done", "running", "queued", "failed"))
        left = f", {timedelta(seconds=round(steps_left / speed))} left" if speed else ""
        return [f"{len(states)} runs: {counts}{left}", *rows]


def main() -> None:
    args = parse(Args, description=__doc__)
    check(args)
    args.out = args.out.resolve()  # the tasks stand elsewhere
    try:
        variants = [read_variant(word, args.total_timesteps) for word in dict.fromkeys(args.variants)]
        # Seed by seed, variants innermost, so that pairs are complete early
        grid = itertools.product(dict.fromkeys(args.seeds), dict.fromkeys(args.games), variants)  # each once
        runs = [Run(game, variant, seed) for seed, game, variant in grid]
        try:
            for run in runs:
                run.look(args)
            if not args.dry_run:
                for directory in ("runs", "logs"):
                    (args.out / directory).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            refuse(f"--out {args.out}", f"cannot be used ({error.strerror}); give another directory")
        if args.dry_run:
            for run in runs:
                todo = f"from step {run.step:,}: {shlex.join(run.command(args))}"
                tell(f"{run.name}: {run.reason or ('finished' if run.state == 'done' else todo)}")
            sys.exit(any(run.state == "failed" for run in runs))
        args.figures &= not any(run.reason for run in runs)  # what is refused would be drawn as this grid's
        if any(run.state == "queued" for run in runs):
            run_grid(runs, args)
        failed = [run for run in runs if run.state == "failed"]
        for run in failed:
            say(f"{run.name}: {run.reason}")
        say(f"{len(runs) - len(failed)} of {len(runs)} runs are done, in {args.out}")
        if args.figures and len(failed) < len(runs):
            figures = [sys.executable, str(Path(__file__).with_name("figures.py")), "--out", str(args.out)]
            names = [variant.name for variant in variants]
            if len(names) > 1 and not {"ppo", "acppo"} <= {*names}:
                figures += ["--baseline", names[0], "--challenger", names[1]]
            sys.exit(subprocess.run(figures).returncode != 0 or bool(failed))
        sys.exit(bool(failed))
    except KeyboardInterrupt:
        say(f"Stopped; go on with the same command: {shlex.join([sys.executable, *sys.argv])}")
        sys.exit(130)


if __name__ == "__main__":
    main()
