"""All that is not the algorithm: a run's arguments, directory, checkpoints and logs, signals, evaluation and videos.

`open_run` chooses between training, resuming and evaluating, and refuses impossible calls. `RunDirectory` holds a run's
checkpoint, event files and `args.json`. `StopSignal`, `Stopwatch` and `StatusLine` serve the training loop. `finish`
ends the call: it evaluates a finished agent, or says how to resume after a signal. Whole games are played by a policy
that is passed in as a function, so this file knows no network and no loss.

`benchmark/` uses the small helpers. They cost no torch, which is imported in the functions that need it.
"""

import ast
import contextlib
import csv
import ctypes
import hashlib
import importlib.metadata
import inspect
import itertools
import json
import math
import os
import platform
import random
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import timedelta
from typing import Annotated, Any, BinaryIO, NoReturn, get_args, get_type_hints

import filelock
import numpy as np
import tyro
from gymnasium.vector import VectorEnv

from wrappers import EnvironmentFailed, canonical_name, env_seeds, make_envs

Policy = Callable[[np.ndarray], np.ndarray]  # observations (N, …) → actions (N,)
PER_CALL_ARGS = {"resume", "evaluate", "stop_at"}  # a run does not keep these
TENSORBOARD_LAYOUT = {  # of TensorBoard's page "Custom Scalars"
    "The thesis's figures": {
        "score, mean of the last 100 games (4.1)": ["Multiline", ["charts/mean_return_100"]],
        "KL between policy updates (4.2)": ["Multiline", ["losses/kl"]],
        "average clip ratio (C.1)": ["Multiline", ["losses/avg_clip_ratio"]],
        "clip fraction": ["Multiline", ["losses/clipfrac"]],
    }
}


# ------------------------------------------------------------------------------------------------ small helpers
def available_cores() -> int:
    """Returns the number of cores that this process may run on: its affinity, if the system has one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def print_message(text: str, end: str = "\n", descriptor: int = 2) -> None:
    """Writes to standard error, or output, and ignores errors: a closed terminal or a full disk must not end a run."""
    start = "\r\x1b[K" if os.isatty(descriptor) else ""  # over the status line
    with contextlib.suppress(OSError):  # not `print`, which a signal's handler must not call
        os.write(descriptor, f"{start}{text}{end}".encode(errors="replace"))


def usage_error(given: str, advice: object) -> NoReturn:
    """Ends the program with status 2 and one line: the refused input, and the advice."""
    print_message(" ".join(f"{given}: {advice}".split()))
    sys.exit(2)


def as_flag(name: str, value: object) -> str:
    """Returns an argument as it is given on the command line, for `usage_error`."""
    return f"--{name.replace('_', '-')} {value}"


@contextlib.contextmanager
def replacing(path: str | os.PathLike) -> Iterator[BinaryIO]:
    """Gives a new file to a `with`, and renames it to `path` in the end. At every instant one of the two is whole."""
    new = f"{os.fspath(path)}.new"
    try:
        with open(new, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # on the disk before the rename is, even if the power fails
        os.replace(new, path)
    except (OSError, RuntimeError):  # torch turns a full disk into a RuntimeError
        with contextlib.suppress(OSError):
            os.remove(new)
        raise


def write_file(path: str | os.PathLike, data: str | bytes) -> None:
    """Replaces a file, text as UTF-8."""
    with replacing(path) as file:
        file.write(data.encode() if isinstance(data, str) else data)


def processor_kind() -> str:
    """Returns the newest vector instructions that torch finds here."""
    import torch

    has = torch.cpu.get_capabilities()
    kinds = {"AMX": "amx_bf16", "AVX512-BF16": "avx512_bf16", "AVX512": "avx512_f", "AVX2": "avx2", "ARM-BF16": "bf16"}
    return next((kind for kind, name in kinds.items() if has.get(name)), has.get("architecture", "unknown"))


def tune_process() -> None:
    """Sets up a process that trains, before it imports torch: its threads, its memory and its denormal numbers."""
    # Idle OpenMP threads would spin on the cores that the games' threads need (docs/speed.md has the measurements)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # glibc returns tensors of megabytes to the system and faults their pages in again at every gradient step. Keeping
    # them cuts an iteration's 16 from 2.1 to 1.7 s. -1 is M_TRIM_THRESHOLD, -3 is M_MMAP_THRESHOLD, in bytes
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-1, 1 << 30)
        if not libc.mallopt(-3, 1 << 30):
            libc.mallopt(-3, 1 << 25)  # the most that an older glibc takes
    import torch

    # Adam's moments of dead units shrink to denormal numbers, at 150 cycles each: late in a run gradient clipping and a
    # step take 2 to 3 times as long (benchmark/tricks.py). Now, because torch's threads inherit this at their start
    list(map(np.finfo, (np.float32, np.float64)))  # before 2.4, numpy warns where it finds them flushed, and remembers
    torch.set_flush_denormal(True)


def code_hash(script: str | os.PathLike) -> str:
    """Returns a hash of what a script does: of its code without docstrings and comments (and of one Python version)."""
    with open(script, encoding="utf-8") as file:
        code = ast.parse(file.read())
    for node in ast.walk(code):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            node.value.value = None
    return f"sha256 {hashlib.sha256(ast.unparse(code).encode()).hexdigest()}"


def rounded(score: float) -> str:
    """Returns a score to three digits, or from 10 on to a decimal: some environments' lie between 0 and 1."""
    return f"{score:.1f}" if abs(score) >= 10 else f"{score:.3g}"


# ---------------------------------------------------------------------------------------------------- arguments
def bounded(kind: type, allow: Callable[[Any], bool], shown: str) -> Any:
    """Returns the type of a field of `Args` with bounds, which `--help` shows and `check_args` enforces."""
    return Annotated[kind, (allow, shown), tyro.conf.arg(metavar=shown)]


PositiveInt = bounded(int, lambda x: 0 < x <= 10**12, "1..10^12")
NonNegativeInt = bounded(int, lambda x: 0 <= x < 2**63, "0..2^63-1")
PositiveFloat = bounded(float, lambda x: 0 < x < 1e30, "0<x<1e30")  # float32 must hold the results
NonNegativeFloat = bounded(float, lambda x: 0 <= x < 1e30, "0<=x<1e30")
NonNegativeOrInf = bounded(float, lambda x: 0 <= x < 1e30 or x == math.inf, "0<=x<1e30|inf")
Fraction = bounded(float, lambda x: 0 <= x <= 1, "0..1")
Threads = bounded(int, lambda x: 0 < x <= 1024, "1..1024")
FileName = bounded(str, lambda x: re.fullmatch(r"[A-Za-z0-9_.-]{1,100}", x), "[A-Za-z0-9_.-]{1,100}")


@dataclass
class RunArgs:
    """The arguments that every script has; its own `Args` adds the environment's and the algorithm's."""

    log_dir: str = "runs"
    """directory that the run's own directory is made in"""
    threads: Threads = field(default_factory=available_cores)
    """threads of torch; the emulators use as many, in turn with it. The default is the cores that this process may use;
    in a container with a CPU quota, which it does not see, give the quota"""
    checkpoint_minutes: NonNegativeOrInf = 5.0
    """wall time between two checkpoints; 0 writes one after every iteration"""
    stop_at: PositiveInt | None = None
    """end this call at this many agent steps (rounded up to whole rollouts), with a checkpoint; the schedule stays that
    of the whole run"""
    resume: str | None = None
    """continue the run in this directory, with its saved arguments; flags given as well override them, but for game,
    rollout, seed and names"""
    evaluate: str | None = None
    """evaluate the checkpoint in this run directory for `--eval-episodes` games, without training"""
    eval_episodes: NonNegativeInt = 10
    """whole games that are played and scored when the training is finished, without learning; 0 for none"""
    capture_video: bool = False
    """film a whole game, into `videos/` of the run, at the start, at each quarter and at the end of the training; with
    `--evaluate`, one game"""

    @property
    def last_iteration(self) -> int:
        """The iteration that this call ends with."""
        stop_at = self.total_timesteps if self.stop_at is None else self.stop_at
        return min(self.num_iterations, math.ceil(stop_at / self.batch_size))

    def rules(self) -> list[tuple[str, bool, str]]:
        """Returns (argument, does it hold, advice) for each rule that involves several arguments."""
        return [
            ("evaluate", self.evaluate is None or self.resume is None, "give either this or --resume"),
            ("evaluate", self.evaluate is None or self.eval_episodes > 0, "give --eval-episodes above 0, too"),
        ]


def check_args(args) -> None:
    """Refuses the first argument that is out of its bounds or breaks one of `args.rules()`."""
    for name, hint in get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        for kind in (hint, *get_args(hint)) if value is not None else ():  # X, or in `X | None` its parts
            for allow, shown in (bounds for bounds in getattr(kind, "__metadata__", ()) if isinstance(bounds, tuple)):
                if not all(map(allow, value if isinstance(value, (list, tuple)) else [value])):
                    usage_error(as_flag(name, value), f"give a value in {shown}")
    for name, holds, advice in args.rules():
        if not holds:
            usage_error(as_flag(name, getattr(args, name)), advice)


def saved_args(args) -> dict[str, object]:
    """Returns the arguments that belong to the run, not to one call of it, as lists, numbers and texts."""
    own = {name: value for name, value in vars(args).items() if name not in PER_CALL_ARGS}
    return json.loads(json.dumps(own, default=str))  # tuples become lists, paths become texts


def as_words(values: dict[str, object], defaults: dict[str, object]) -> list[str]:
    """Returns saved arguments as words of a command line, without those that have their default."""
    words = []
    for name, value in values.items():
        flag = name.replace("_", "-")
        if value == defaults[name]:
            continue
        if isinstance(value, bool):
            words.append(f"--{'' if value else 'no-'}{flag}")
        else:
            words += [f"--{flag}", *map(str, value)] if isinstance(value, list) else [f"--{flag}={value}"]
    return words


def repeat_command(args) -> str:
    """Returns the command that repeats the run: all that is not the default, and always game, seed and threads."""
    defaults = saved_args(type(args)()) | dict.fromkeys(("env_id", "seed", "threads"))
    return shlex.join(["python", os.path.basename(inspect.getfile(type(args))), *as_words(saved_args(args), defaults)])


def call_command(args, *flags: str) -> str:
    """Returns the command that calls this script with other flags, from any directory."""
    return shlex.join([sys.executable, os.path.abspath(inspect.getfile(type(args))), *flags])


# ------------------------------------------------------------------------------------------------ run directory
class RunDirectory:
    """A run's checkpoint and event files, held by one process at a time. A full disk costs points, not the run."""

    def __init__(self, path: str):
        """Opens an existing directory. Raises OSError; filelock.Timeout, which is one, if another process holds it."""
        self.path = os.path.abspath(path)
        self.checkpoint = os.path.join(self.path, "checkpoint.pt")
        # On a file, because NFS does not pass locks on directories on. The lock dies with its process, the file stays.
        self.lock = filelock.FileLock(os.path.join(self.path, "run.lock"))
        self.lock.acquire(blocking=False)
        self.writer = None  # of TensorBoard's event file
        self.write_errors: set[str] = set()  # what could not be written
        self.iteration = 0  # of the last checkpoint
        self.learner, self.logged_step = None, 0  # agent and optimizer, and the agent step that they are as after
        self.num_starts = 0  # before this one; each start of a run plays other games
        self.last_scores = deque(maxlen=100)  # raw returns of whole games
        self.checkpoint_due = 0.0

    @classmethod
    def make(cls, args, start_directory: str = ".") -> "RunDirectory":
        """Makes a new run's directory in `args.log_dir`. If its name is taken, it gets that of the next second."""
        name = re.sub(r"[^\w.-]", "-", canonical_name(args.env_id))
        try:
            for second in itertools.count(int(time.time())):
                path = os.path.join(start_directory, args.log_dir, f"{name}__{args.exp_name}__{args.seed}__{second}")
                with contextlib.suppress(FileExistsError):
                    os.makedirs(path)
                    return cls(path)
        except OSError as error:
            usage_error(as_flag("log_dir", args.log_dir), f"cannot be written ({error.strerror}); give another")

    @classmethod
    def open(cls, path: str, name: str, args_class: type) -> tuple["RunDirectory", dict]:
        """Returns the run in a directory that was given as the argument `name`, and its checkpoint; see `load`."""
        path = path.removesuffix("checkpoint.pt") or "."
        try:
            if not os.path.exists(os.path.join(path, "checkpoint.pt")):  # asked before the lock, which leaves a file
                raise ValueError("it holds no checkpoint.pt")
            run = cls(path)
            return run, run.load(args_class)
        except filelock.Timeout:
            usage_error(as_flag(name, path), "another process holds it; wait for its end")
        except (OSError, ValueError) as error:
            usage_error(as_flag(name, path), getattr(error, "strerror", None) or error)

    def load(self, args_class: type) -> dict:
        """Returns the checkpoint. Raises ValueError if it is not one of a script with these arguments."""
        import torch

        try:
            with zipfile.ZipFile(self.checkpoint) as archive:
                whole = archive.testzip() is None  # torch.load itself takes flipped bytes for parameters
            state = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
            state["args"].pop("compile", None)  # the finished runs of commit 3a0949c have it, and another name for:
            state["num_starts"] = state.pop("starts", state.get("num_starts"))
            others = state["args"].keys() ^ (args_class.__dataclass_fields__.keys() - PER_CALL_ARGS)
            if not (whole and all(tensor.isfinite().all() for tensor in state["agent"].values())):
                raise ValueError("not what was written")
        except Exception as error:  # a file that is no checkpoint can make them raise anything
            raise ValueError("its checkpoint is damaged, or not a checkpoint") from error
        if others:
            raise ValueError(f"its checkpoint is of another script, which differs in {', '.join(sorted(others))}")
        return state

    def restore_agent(self, state: dict, agent) -> None:
        """Loads the parameters of the checkpoint `state`, or refuses those of another network."""
        try:
            agent.load_state_dict(state["agent"])
        except RuntimeError as error:
            usage_error(self.path, f"its checkpoint does not fit this script's network ({error})")
        self.iteration = state["iteration"]

    def start(self, args, state: dict | None, agent, optimizer) -> int:
        """Starts afresh, or restores the checkpoint `state` into `agent` and `optimizer`; returns the iterations done.

        The emulators' state is not saved, so a resumed run starts new games. Points logged after the checkpoint are
        cut from the event files, for every reader of them.
        """
        import torch

        if state is not None:
            self.restore_agent(state, agent)
            # Without the groups' options: a resumed call may have another learning rate
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})
            torch.set_rng_state(state["rng"][0])
            if len(state["rng"]) > 1 and next(agent.parameters()).is_cuda:
                torch.cuda.set_rng_state(state["rng"][1])
            self.num_starts = state["num_starts"]
            self.last_scores.extend(state["last_scores"])
            with self.reporting("the event file"):
                sizes = self.event_files()  # the checkpoint names all of the run's: each start writes one at once
                for name in state["event_files"].keys() & sizes.keys():
                    os.truncate(os.path.join(self.path, name), min(sizes[name], state["event_files"][name]))
        self.learner, self.logged_step = (agent, optimizer), self.iteration * args.batch_size
        self.describe(args, self.logged_step)
        return self.iteration

    def describe(self, args, step: int) -> None:
        """Writes the run's arguments and provenance to `args.json` and TensorBoard, and the layout of its page."""
        about = {
            "command": repeat_command(args),
            "started_at_step": step,  # above 0 for a resumed run, which the command does not repeat
            # JSON has no infinity
            "args": {name: str(value) if value == math.inf else value for name, value in saved_args(args).items()},
            "provenance": provenance(inspect.getfile(type(args))),
        }
        with self.reporting("args.json"):
            write_file(os.path.join(self.path, "args.json"), json.dumps(about, indent=2))
        start = {"command": about["command"], "started_at_step": step, **about["provenance"]}
        events = [("add_custom_scalars", TENSORBOARD_LAYOUT)]
        for tag, rows in (("hyperparameters", about["args"]), ("provenance", start)):
            table = ["|name|value|", "|-|-|", *(f"|{name}|{value}|" for name, value in rows.items())]
            events.append(("add_text", tag, "\n".join(table), step))
        self.add_events(events)

    def log(self, step: int, scalars: dict[str, float], games: list[tuple[int, float, int]] = ()) -> None:
        """Writes scalars at an agent step, and games as (agent step, score, length) at the steps where they ended."""
        self.logged_step = step
        self.last_scores.extend(score for _, score, _ in games)
        mean = {"charts/mean_return_100": np.mean(self.last_scores)} if self.last_scores else {}
        points = [("charts/episodic_return", score, end) for end, score, _ in games]
        points += [("charts/episodic_length", length, end) for end, _, length in games]
        points += [(tag, value, step) for tag, value in {**mean, **scalars}.items()]
        self.add_events([("add_scalar", *point) for point in points])

    def add_events(self, events: list[tuple]) -> None:
        """Calls methods of TensorBoard's writer, (name, arguments …), and flushes it.

        A writer that fails stays dead, so the next call has another, with a file of its own.
        """
        from torch.utils.tensorboard import SummaryWriter

        with self.reporting("the event file"):
            try:
                self.writer = self.writer or SummaryWriter(self.path)
                for method, *given in events:
                    getattr(self.writer, method)(*given)
                self.writer.flush()
            except OSError:
                self.writer = None
                for name in (name for name, size in self.event_files().items() if size == 0):
                    os.remove(os.path.join(self.path, name))  # a full disk would get one at every call
                raise

    def log_evaluation(self, games: list[tuple[float, int]], stats: dict[str, float], step: int, seed: int) -> None:
        """Writes games as (score, length) to `eval.csv`, in place of rows of the same ones, and their statistics to an
        event file of their own, which a resumed run keeps, however far the training had got.
        """
        from torch.utils.tensorboard import SummaryWriter

        path = os.path.join(self.path, "eval.csv")
        with self.reporting("the evaluation"):
            names, rows = ("step", "seed", "game", "score", "length"), []
            with contextlib.suppress(FileNotFoundError), open(path, encoding="utf-8", newline="") as file:
                rows = [[row.get(name, "") for name in names] for row in csv.DictReader(file)]
            rows = [row for row in rows if row[1] or row[0] != str(step)]  # older runs do not say the seed
            rows += [[str(step), str(seed), str(number), *game] for number, game in enumerate(games, start=1)]
            last = {tuple(row[:3]): row for row in rows}
            write_file(path, "".join(f"{','.join(map(str, row))}\n" for row in (names, *last.values())))
            with SummaryWriter(self.path, filename_suffix=".eval") as writer:
                for name, value in stats.items():
                    writer.add_scalar(f"eval/{name}", value, step)

    def save(self, args, iteration: int, agent, optimizer) -> None:
        """Writes a checkpoint next to the last one and renames it: at every instant one of the two is whole."""
        import torch

        rng = [torch.get_rng_state()]
        if next(agent.parameters()).is_cuda:
            rng.append(torch.cuda.get_rng_state())
        state = {"args": saved_args(args), "iteration": iteration, "global_step": iteration * args.batch_size}
        state |= {"agent": agent.state_dict(), "optimizer": optimizer.state_dict()["state"], "rng": rng}
        state |= {"num_starts": self.num_starts + 1, "last_scores": list(self.last_scores)}
        with self.reporting("the checkpoint"):
            try:
                with replacing(self.checkpoint) as file:
                    torch.save({**state, "event_files": self.event_files()}, file)  # which a resumed run cuts to that
            except RuntimeError as error:
                raise OSError(str(error)) from error
            self.iteration = iteration
        self.checkpoint_due = time.perf_counter() + 60 * args.checkpoint_minutes

    def is_checkpoint_due(self) -> bool:
        return time.perf_counter() >= self.checkpoint_due

    @contextlib.contextmanager
    def reporting(self, what: str, *others: type[Exception]) -> Iterator[None]:
        """Says once that `what` cannot be written, at an OSError or another of these, and carries on."""
        try:
            yield
        except (OSError, *others) as error:
            if what not in self.write_errors:
                print_message(f"{self.path}: {what} cannot be written ({error}); carrying on without")
            self.write_errors.add(what)

    def event_files(self) -> dict[str, int]:
        """Returns the size in bytes of each event file of the training, by name."""
        files = [file for file in os.scandir(self.path) if file.name.startswith("events.")]
        return {file.name: file.stat().st_size for file in files if not file.name.endswith(".eval")}


def git_commit(script: str, checkout: str | None = None) -> str:
    """Returns the commit of this checkout, or of another; `-dirty` if it has changes, or does not hold the script."""
    here = checkout or os.path.dirname(os.path.abspath(__file__))
    environment = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # as in a hook

    def git(*words: str) -> str:
        run = subprocess.run(["git", "-C", here, *words], capture_output=True, text=True, env=environment)
        return run.stdout.strip() if run.returncode == 0 else ""

    try:
        commit = git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")  # the hash, not a tag
        if not commit or (checkout is None and not git("ls-files", os.path.abspath(__file__))):
            return "unknown"  # no checkout, or a copy inside another repository
        return commit if git("ls-files", os.path.abspath(script)) or commit.endswith("-dirty") else f"{commit}-dirty"
    except OSError:
        return "unknown (git is not installed)"


def provenance(script: str) -> dict[str, object]:
    """Returns the versions, commit, machine and threads, which a reader needs to repeat a run."""
    import torch

    versions = {"python": platform.python_version()}
    for package in ("torch", "gymnasium", "ale-py", "numpy", "opencv-python-headless", "tensorboard", "tyro"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # opencv-python in place of the headless one, for example
            versions[package] = "unknown"
    machine = f"{platform.platform()}, {available_cores()} cores, {processor_kind()}"
    waiting = (f"{name} {os.environ.get(name, 'not set')}" for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"))
    threads = f"{torch.get_num_threads()} torch, {', '.join(waiting)}"
    versions["script"] = code_hash(script)
    return {"commit": git_commit(script), **versions, "machine": machine, "threads": threads}


# ---------------------------------------------------------------------------------------- for the training loop
class StopSignal:
    """Notes the first SIGINT, SIGTERM or SIGHUP in `number`, for a clean end; one that comes later ends at once.

    Later is a second or more: launchers send the same signal to a process and to its group, which it is in. A signal
    that is ignored when the script starts stays ignored, as after `nohup`.
    """

    def __init__(self):
        self.number, self.process, self.awaited = 0, os.getpid(), []

    def listen(self) -> None:
        numbers = (getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP"))  # Windows has no SIGHUP
        self.awaited = [n for n in numbers if n is not None and signal.getsignal(n) != signal.SIG_IGN]
        self.listen_again()

    def listen_again(self) -> None:
        """Takes back the signals for which a library in an environment has set a handler."""
        for number in self.awaited:
            signal.signal(number, self.note)

    def note(self, number: int, frame: object) -> None:
        if os.getpid() != self.process:  # a child that an environment has forked
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        elif not self.number:
            self.since, self.number = time.monotonic(), number
            print_message("Stopping cleanly; another signal, at least a second from now, ends at once")
        elif time.monotonic() - self.since >= 1:
            os._exit(128 + number)  # not by SIG_DFL, which the kernel ignores for process 1 of a container


class Stopwatch:
    """Measures the phases of an iteration, and the speed over the last ten (a GPU's work counts when it is awaited)."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()
        self.iteration_ends = deque([self.last], maxlen=11)

    def lap(self, phase: str) -> None:
        """Counts the time since the last lap as `phase`."""
        now = time.perf_counter()
        self.seconds[phase] = self.seconds.get(phase, 0.0) + now - self.last
        self.last = now

    def end_iteration(self, batch_size: int) -> dict[str, float]:
        """Returns the tags of an iteration of `batch_size` agent steps. Later time counts in the next one."""
        self.lap("rest")
        self.iteration_ends.append(self.last)
        sps = (len(self.iteration_ends) - 1) * batch_size / (self.iteration_ends[-1] - self.iteration_ends[0])
        tags = {"charts/SPS": sps, **{f"time/{phase}": seconds for phase, seconds in self.seconds.items()}}
        self.seconds = {}
        return tags


class StatusLine:
    """One line that is written over in a terminal; a new line each minute if standard error goes to a file."""

    def __init__(self):
        self.due = time.perf_counter() + 60

    def show(self, args, iteration: int, sps: float, last_scores: deque) -> None:
        step, last_step = iteration * args.batch_size, args.last_iteration * args.batch_size
        score = f", score {rounded(np.mean(last_scores))}" if last_scores else ""
        left = timedelta(seconds=int((last_step - step) / sps))
        line = f"step {step:,} of {last_step:,}, {sps:.0f} SPS{score}, {left} left"
        if os.isatty(2):
            line = line[: (os.get_terminal_size(2).columns or 80) - 1]  # a line that wraps cannot be written over
            print_message(line, end="\n" if iteration == args.last_iteration else "")
        elif time.perf_counter() >= self.due:
            print_message(line)
            self.due = time.perf_counter() + 60


# -------------------------------------------------------------------------------------------- playing whole games
def play(
    policy: Policy, envs: VectorEnv, num_games: int, seed: list[int], stop: StopSignal | None = None
) -> list[tuple[float, int]]:
    """Plays whole games without learning, and returns (score, agent steps) of each, fewer if `stop` notes a signal.

    Each environment plays a fixed number of games; taking the first to finish would over-sample short ones. Games that
    do not end are left out.
    """
    stop = stop or StopSignal()
    obs, _ = envs.reset(seed=env_seeds(seed, envs.num_envs))
    stop.listen_again()
    games = [[] for _ in range(envs.num_envs)]
    # Environment n plays the games n, n + N, n + 2N, … of all
    shares = [len(range(n, num_games, envs.num_envs)) for n in range(envs.num_envs)]
    steps_left = 27_000 * max(shares)  # Atari's longest games; other environments may have no time limit
    while any(len(played) < share for played, share in zip(games, shares)) and steps_left > 0 and not stop.number:
        steps_left -= 1
        obs, _, _, _, infos = envs.step(policy(obs))
        for n in np.flatnonzero(infos.get("_episode", False)):
            games[n].append((float(infos["episode"]["r"][n]), int(infos["episode"]["l"][n])))
    numbered = (divmod(number, envs.num_envs) for number in range(num_games))
    return [games[n][turn] for turn, n in numbered if turn < len(games[n])]


def evaluate(args, policy: Policy, run: RunDirectory, step: int, stop: StopSignal) -> bool:
    """Plays `args.eval_episodes` games with the policy of agent step `step`, and prints and logs their scores.

    Returns False if `stop` notes a signal before the last one has ended.
    """
    with contextlib.closing(make_envs(args.env_id, args.num_envs, args.threads)) as envs:  # so each game has its number
        games = play(policy, envs, args.eval_episodes, [args.seed, 1], stop)
    if stop.number:
        return False
    if len(games) < args.eval_episodes:
        print_message(f"{args.eval_episodes - len(games)} of {args.eval_episodes} games did not end, they are left out")
    scores = np.array([score for score, _ in games] or [math.nan])
    std = scores.std(ddof=1) if len(scores) > 1 else 0.0
    stats = {"mean": scores.mean(), "std": std, "median": np.median(scores), "min": scores.min(), "max": scores.max()}
    run.log_evaluation(games, stats, step, args.seed)
    described = " ".join(f"{name} {rounded(value)}" for name, value in stats.items())
    print_message(f"{len(games)} games at step {step:,}: {described}", descriptor=1)
    return True


def record_game(args, policy: Policy, run: RunDirectory, step: int, stop: StopSignal) -> None:
    """Plays one game into `videos/` of the run, with its score in the file's name; none if `stop` notes a signal."""
    path = os.path.join(run.path, "videos", f"step_{step}")
    with run.reporting("the video", EnvironmentFailed, ValueError):  # the latter if it cannot be built once more
        os.makedirs(os.path.dirname(path), exist_ok=True)
        try:
            with contextlib.closing(make_envs(args.env_id, 1, args.threads, video=path + ".mp4")) as envs:
                scores = [score for score, _ in play(policy, envs, 1, [args.seed, 2], stop)]
            if not stop.number:
                result = f"score_{scores[0]:.10g}" if scores else "without_end"
                os.replace(path + ".mp4", f"{path}_{result}.mp4")
        finally:
            with contextlib.suppress(OSError):
                os.remove(path + ".mp4")  # of a game cut short, or a full disk


def record_game_if_due(
    args, fresh_policy: Callable[[], Policy], run: RunDirectory, iteration: int, stop: StopSignal
) -> None:
    """Records a game at the start, at each quarter and at the end of the training, with `--capture-video`."""
    if args.capture_video and not stop.number and iteration in [args.num_iterations * k // 4 for k in range(5)]:
        record_game(args, fresh_policy(), run, iteration * args.batch_size, stop)


# --------------------------------------------------------------------------------------------------- command line
def open_run(args_class: type, description: str):
    """Chooses between training anew, resuming and evaluating, and refuses impossible calls with status 2.

    Returns the arguments, the environments, the run, its checkpoint (None for a new run) and the stop signal.
    """
    import torch

    args = tyro.cli(args_class, description=description)
    stop = StopSignal()
    stop.listen()
    # TensorBoard's writer raises an error of its thread where it is flushed; Python would print a traceback as well
    threading.excepthook = lambda error: issubclass(error.exc_type, OSError) or threading.__excepthook__(error)
    run = state = None
    name = "evaluate" if args.resume is None else "resume"
    if (directory := getattr(args, name)) is not None:
        run, state = RunDirectory.open(directory, name, args_class)
        this_call = {"resume": args.resume, "evaluate": args.evaluate}
        if name == "evaluate":  # the run's own are for its training
            this_call |= {own: getattr(args_class(), own) for own in ("capture_video", "eval_episodes", "threads")}
        saved = tyro.cli(args_class, args=as_words(state["args"], saved_args(args_class())))
        args = tyro.cli(args_class, description=description, default=replace(saved, **this_call))
        for fixed in ("env_id", "num_envs", "num_steps", "exp_name", "seed"):  # an evaluation may have another seed
            if getattr(args, fixed) != state["args"][fixed] and (fixed, name) != ("seed", "evaluate"):
                message = f"the run has {state['args'][fixed]}, which cannot change"
                usage_error(as_flag(fixed, getattr(args, fixed)), message)
    check_args(args)
    torch.set_num_threads(args.threads)
    if args.resume is not None and state["iteration"] >= args.last_iteration:
        limit = "--total-timesteps" if state["iteration"] >= args.num_iterations else "--stop-at"
        done = f"{run.path} is finished up to {limit}, at step {state['global_step']}"
        print_message(f"{done}; a larger one takes it further, and --evaluate plays games", descriptor=1)
        sys.exit()
    start_directory = os.getcwd()  # which an environment may leave
    random.seed(args.seed)  # for environments that draw from these
    np.random.seed(args.seed % 2**32)
    try:
        if args.capture_video:
            make_envs(args.env_id, 1, video="none yet").close()  # refused now, if it cannot be rendered
        envs = make_envs(args.env_id, args.num_envs if args.evaluate is None else 1, args.threads)
        if args.evaluate is not None:
            envs.close()  # it has told its spaces; the evaluation builds its own, and some can only exist once
        stop.listen_again()
    except (OSError, ValueError) as error:
        usage_error(as_flag("env_id", args.env_id), error)
    if args.evaluate is None and hasattr(os, "sysconf"):  # not on Windows
        space, memory = envs.observation_space, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
        if (needed := args.num_steps * math.prod(space.shape) * space.dtype.itemsize / 2**30) > memory:
            advice = f"a rollout's observations take {needed:,.0f} GiB, this machine has {memory:,.0f}"
            usage_error(as_flag("num_steps", args.num_steps), advice)
    run = run or RunDirectory.make(args, start_directory)  # last, so that nothing refused above leaves one behind
    emulated = args.bf16 and processor_kind() not in ("AMX", "AVX512-BF16", "ARM-BF16")
    if emulated and not (args.cuda and torch.cuda.is_available()):
        print_message("--bf16: this processor has no bfloat16 instructions; expect a tenth of float32's speed")
    if args.evaluate is None:
        first, last = (state["global_step"] if state else 0), args.last_iteration * args.batch_size
        print_message(f"{run.path}: from step {first:,} to {last:,}")
    return args, envs, run, state, stop


@contextlib.contextmanager
def ending_in_one_line(args, run: RunDirectory, stop: StopSignal) -> Iterator[None]:
    """Ends a run whose numbers are not finite, or whose environment fails, which costs it no whole iteration."""
    try:
        yield
    except FloatingPointError as error:
        print_message(f"{run.path}: {error}")
        sys.exit(1)
    except EnvironmentFailed as error:
        print_message(f"{args.env_id} failed with {' '.join(str(error).split())}")
        if run.learner is not None:  # since the last update, which is logged, nothing has changed the parameters
            run.save(args, run.logged_step // args.batch_size, *run.learner)
        how = "--evaluate" if args.evaluate is not None or run.iteration == args.num_iterations else "--resume"
        print_message(f"Stopped; continue with: {call_command(args, how, run.path)}")
        sys.exit(128 + stop.number if stop.number else 1)


def finish(args, fresh_policy: Callable[[], Policy], run: RunDirectory, stop: StopSignal) -> NoReturn:
    """Ends a call whose agent is trained or loaded: evaluates it, or says how to continue. Exits with its status."""
    step, evaluate_only = run.iteration * args.batch_size, args.evaluate is not None  # of the last checkpoint
    done = evaluate_only or run.iteration >= args.last_iteration
    cut_short = stop.number and not done
    if evaluate_only or (run.iteration == args.num_iterations and args.eval_episodes > 0):
        if stop.number or not evaluate(args, fresh_policy(), run, step, stop):
            print_message(f"Not evaluated; do that with: {call_command(args, '--evaluate', run.path)}")
            cut_short = True
        elif evaluate_only and args.capture_video:  # a training has filmed its last agent already
            record_game(args, fresh_policy(), run, step, stop)
    elif run.iteration < args.num_iterations and os.path.exists(run.checkpoint):
        why = "Stopped" if stop.number else "At --stop-at" if done else "Not saved"
        stop_at = [] if done or args.stop_at is None else ["--stop-at", str(args.stop_at)]
        print_message(f"{why}; continue with: {call_command(args, '--resume', run.path, *stop_at)}")
    sys.exit(128 + stop.number if cut_short else 1 if run.write_errors else 0)
