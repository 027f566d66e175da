"""All that is not the algorithm: run directories, checkpoints, logging, signals, evaluation and videos.

`open_run` chooses between training, resuming and evaluating, and refuses impossible calls. `RunDirectory` holds a run's
checkpoint, event files and `args.json`. `StopSignal`, `Stopwatch` and `StatusLine` accompany the loop, and `finish`
ends the call: it evaluates a finished agent, or says how to go on after a signal. Whole games are played by a policy
that is passed in as a function, so this file knows no network and no loss.

`benchmark/` uses the small helpers at the top. They cost no torch: it is imported in the functions that need it.
"""

import ast
import contextlib
import csv
import ctypes
import glob
import hashlib
import importlib.metadata
import inspect
import io
import itertools
import json
import math
import os
import platform
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
import tokenize
import typing
import zipfile
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import filelock
import numpy as np
import tyro
from gymnasium.vector import VectorEnv

from wrappers import canonical_name, env_seeds, make_envs

Policy = Callable[[np.ndarray], np.ndarray]  # observations (N, …) → actions (N,)
OF_ONE_CALL = {"resume", "evaluate", "stop_at"}  # arguments that a run does not keep
RETIRED = {"compile"}  # arguments that older checkpoints have
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
    """Returns the number of cores this process may run on: its affinity, if the system has one."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def say(text: str, end: str = "\n") -> None:
    """Writes to standard error and ignores errors: a closed pipe or a full disk must not end a run."""
    start = "\r\x1b[K" if os.isatty(2) else ""  # over the status line
    with contextlib.suppress(OSError):
        os.write(2, (start + text + end).encode(errors="surrogateescape"))


def tell(text: str) -> None:
    """Writes to standard output and ignores errors: a result that nobody reads is no failure."""
    with contextlib.suppress(OSError):
        os.write(1, (text + "\n").encode(errors="surrogateescape"))


def in_utf8(text: str, errors: str = "replace") -> str:
    """Returns a text of the command line as its bytes read in UTF-8, whatever the locale has made of them."""
    return text.encode(errors="surrogateescape").decode(errors=errors)


def refuse(given: str, advice: object) -> typing.NoReturn:
    """Ends the program with status 2 and one line: the refused input, and the advice."""
    say(" ".join(f"{given}: {advice}".split()))
    sys.exit(2)


def flag(name: str, value: object) -> str:
    """Returns an argument as it is given on the command line, for `refuse`."""
    return f"--{name.replace('_', '-')} {value}"


def parse(args_class: Callable, **given):
    """Parses the command line with tyro. `--help` that has no reader, or no letter for ε, is no failure.

    Refuses what is not UTF-8, and a path below a directory whose name is not: no record could hold it.
    """
    for descriptor in range(3):  # of those that were closed before Python started, a file of ours would get the number
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    if sys.stdout is None:  # closed before Python started
        sys.stdout = open(os.devnull, "w", encoding="utf-8")
    sys.stdout.reconfigure(errors="replace")
    try:
        try:
            args = tyro.cli(args_class, **given)
        finally:
            sys.stdout.flush()
    except OSError:  # Python would flush again at its end, and fail
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        sys.exit(0 if {"-h", "--help"} & set(sys.argv) else 2)
    for name, value in getattr(args, "__dict__", {}).items():
        for one in value if isinstance(value, tuple) else [value]:
            text = str(one.absolute() if isinstance(one, Path) else one)
            try:
                in_utf8(text, errors="strict")
            except UnicodeDecodeError:
                refuse(flag(name, text), "give it in UTF-8")
    return args


def file_name(script: str) -> str:
    """Returns a name for a script's runs: that of its file, without characters unfit for a directory's name."""
    return re.sub(r"[^\w.-]", "-", os.path.basename(script).removesuffix(".py"))[:100] or "run"


def write_text(path: str | os.PathLike, text: str) -> None:
    """Replaces a file by UTF-8 text, as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_bytes(path: str | os.PathLike, data: bytes) -> None:
    """Replaces a file: writes a new one beside it and renames that. One of the two is always whole.

    Raises OSError, with the file's name in it.
    """
    new = f"{os.fspath(path)}.new"
    try:
        with open(new, "wb") as file:
            file.write(data)
        os.replace(new, path)
    except OSError as error:
        with contextlib.suppress(OSError):
            os.remove(new)  # half of it would fill the disk further
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error


def append(path: str, data: bytes) -> None:
    """Appends to a file, which may not exist yet: all of `data`, or nothing and OSError."""
    size = os.path.getsize(path) if os.path.exists(path) else 0
    try:
        with open(path, "ab") as file:
            file.write(data)
    except OSError:
        with contextlib.suppress(OSError):
            os.truncate(path, size) if size else os.remove(path)
        raise


def kind_of_processor() -> str:
    """Returns the newest vector instructions that torch finds here."""
    import torch

    has = torch.cpu.get_capabilities()
    kinds = {"AMX": "amx_bf16", "AVX512-BF16": "avx512_bf16", "AVX512": "avx512_f", "AVX2": "avx2", "ARM-BF16": "bf16"}
    return next((kind for kind, name in kinds.items() if has.get(name)), has.get("architecture", "unknown"))


def warn_of_emulation(args) -> None:
    """Says that `--bf16` is slow here, if it is: on a processor without instructions for it."""
    import torch

    on_gpu = args.cuda and torch.cuda.is_available()
    if args.bf16 and not on_gpu and kind_of_processor() not in ("AMX", "AVX512-BF16", "ARM-BF16"):
        say("--bf16: this processor has no bfloat16 instructions; expect a tenth of float32's speed")


def tune_process() -> None:
    """Sets up a process that trains, before it imports torch: how threads wait, and how memory is kept."""
    # Idle OpenMP threads would spin on the cores that the games' threads need. GOMP_SPINCOUNT=10000 has them spin for a
    # moment: a tenth faster if nothing else runs, a fifth slower beside one other process (benchmark/README.md)
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # glibc returns tensors of megabytes to the system and faults their pages in again, 16 times an iteration. Keeping
    # them cuts these 16 steps from 2.1 to 1.7 s. -1 is M_TRIM_THRESHOLD, -3 is M_MMAP_THRESHOLD, in bytes.
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(-1, 1 << 30)
        if not libc.mallopt(-3, 1 << 30):
            libc.mallopt(-3, 1 << 25)  # the most that an older glibc takes
    import torch

    # Adam's moments of dead units shrink to denormal numbers, at 150 cycles each: late in a run gradient clipping and a
    # step take 2 to 4 times as long (benchmark/tricks.py). Now, because torch's threads inherit this at their start
    torch.set_flush_denormal(True)


def code_lines(script: str | os.PathLike) -> list[str]:
    """Returns a script's lines without docstrings, comments and blank lines."""
    with tokenize.open(script) as file:
        source = file.read()
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            lines[token.start[0] - 1] = lines[token.start[0] - 1][: token.start[1]]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines[node.lineno - 1 : node.end_lineno] = [""] * (node.end_lineno - node.lineno + 1)
    return [line.rstrip() for line in lines if line.strip()]


def code_hash(script: str | os.PathLike) -> str:
    """Returns a hash of what a script does: of its code, so that another comment makes no other script."""
    return f"sha256 {hashlib.sha256(chr(10).join(code_lines(script)).encode()).hexdigest()}"


class Progress(NamedTuple):
    """How far a run is. As text it is the status line, which `find` reads again."""

    step: int  # agent steps done
    last_step: int  # with which this call ends
    steps_per_second: float
    score: float | None  # mean of the last 100 games

    def __str__(self) -> str:
        left = timedelta(seconds=int((self.last_step - self.step) / self.steps_per_second))
        score = "" if self.score is None else f", score {self.score:.1f}"
        return f"step {self.step:,} of {self.last_step:,}, {self.steps_per_second:.0f} SPS{score}, {left} left"

    @classmethod
    def find(cls, text: str) -> "Progress | None":
        """Returns the last status line in a text."""
        lines = re.findall(r"step ([\d,]+) of ([\d,]+), (\d+) SPS(?:, score (-?[\d.]+))?", text)
        if not lines:
            return None
        step, last_step, speed, score = lines[-1]
        return cls(
            int(step.replace(",", "")), int(last_step.replace(",", "")), float(speed), float(score) if score else None
        )


def write_file(path: str | os.PathLike, data: str | bytes) -> None:
    """Replaces a file, text as UTF-8: writes a new one beside it and renames that. One of the two is always whole.

    Raises OSError, with the file's name in it.
    """
    write_bytes(path, data.encode() if isinstance(data, str) else data)


# --------------------------------------------------------------------------------------------- bounds of arguments
@dataclass(frozen=True)
class Bounds:
    """The values that an argument may have, beside its type."""

    allow: Callable[[Any], bool]
    advice: str


def bounded(kind: type, allow: Callable[[Any], bool], metavar: str, advice: str) -> Any:
    """Returns the type of a field of `Args` with bounds, which `--help` shows and `check` enforces."""
    return Annotated[kind, Bounds(allow, f"give {advice}"), tyro.conf.arg(metavar=metavar)]


PositiveInt = bounded(int, lambda x: 0 < x <= 10**12, "1..10^12", "a whole number from 1 to 10^12")
NonNegativeInt = bounded(int, lambda x: 0 <= x < 2**64, "0..2^64-1", "a whole number from 0 to 2^64 - 1")
# Below 1e30, because float32 must hold the results
PositiveFloat = bounded(float, lambda x: 0 < x < 1e30, ">0", "a number above 0 and below 1e30")
NonNegativeFloat = bounded(float, lambda x: 0 <= x < 1e30, ">=0", "a number from 0 to below 1e30")
NonNegativeOrInf = bounded(
    float, lambda x: 0 <= x < 1e30 or x == math.inf, ">=0|inf", "a number from 0 to below 1e30, or inf"
)
Fraction = bounded(float, lambda x: 0 <= x <= 1, "0..1", "a number from 0 to 1")
MOST_THREADS = 4 * available_cores()
Threads = bounded(int, lambda x: 0 < x <= MOST_THREADS, f"1..{MOST_THREADS}", f"a number from 1 to {MOST_THREADS}")
FileName = bounded(
    str, lambda x: re.fullmatch(r"[\w.-]{1,100}", x), "NAME", "up to 100 letters, digits, '.', '_' and '-'"
)


def check(args) -> None:
    """Refuses the first argument that is out of its bounds or breaks one of `args.rules()`."""
    for name, hint in typing.get_type_hints(type(args), include_extras=True).items():
        value = getattr(args, name)
        for kind in (hint, *typing.get_args(hint)) if value is not None else ():  # `X | None` has X among its args
            for bounds in getattr(kind, "__metadata__", ()):
                if isinstance(bounds, Bounds) and not bounds.allow(value):
                    refuse(flag(name, value), bounds.advice)
    for name, holds, advice in args.rules():
        if not holds:
            refuse(flag(name, getattr(args, name)), advice)


# ------------------------------------------------------------------------------------------------ run directory
class RunDirectory:
    """A run's checkpoint and event files, held by one process at a time. A full disk costs points, not the run."""

    def __init__(self, path: str):
        """Opens an existing directory. Raises OSError; filelock.Timeout if another process holds it.

        One that cannot be written, on a read-only file system for example, is opened for evaluations, without a lock.
        """
        os.listdir(path)
        self.path, self.checkpoint = path, os.path.join(path, "checkpoint.pt")
        # On a file, because NFS does not pass locks on directories on. The lock dies with its process, the file stays.
        self.lock = filelock.FileLock(os.path.join(path, "run.lock"))
        if self.can_be_written(path):
            self.lock.acquire(blocking=False)
        self.trains = False
        self.event_file: EventFile | None = None  # of this start
        self.not_written: set[str] = set()
        self.films_cut_short = 0  # by a signal
        self.iteration = 0  # of the last checkpoint
        self.num_starts = 0  # each start of a run plays games of its own
        self.last_scores = deque(maxlen=100)  # raw returns of whole games
        self.checkpoint_due = 0.0

    @classmethod
    def make(cls, args) -> "RunDirectory":
        """Makes a new run's directory in `args.log_dir`. If its name is taken, it gets that of the next second."""
        name = re.sub(r"[^\w.-]", "-", canonical_name(args.env_id))
        try:
            for second in itertools.count(int(time.time())):
                path = os.path.join(args.log_dir, f"{name}__{args.exp_name}__{args.seed}__{second}")
                with contextlib.suppress(FileExistsError):
                    os.makedirs(path)
                    break
            return cls(path)
        except OSError as error:
            shutil.rmtree(path, ignore_errors=True)  # made, but not to be locked
            refuse(flag("log_dir", args.log_dir), f"cannot be written ({error.strerror}); give another directory")

    @classmethod
    def open(cls, path: str, name: str, args_class: type) -> tuple["RunDirectory", dict]:
        """Returns the run in a directory that was given as the argument `name`, and its checkpoint; see `load`."""
        if os.path.basename(path) == "checkpoint.pt":
            path = os.path.dirname(path) or "."
        try:
            if "checkpoint.pt" not in os.listdir(path):  # asked before the lock, which leaves a file
                below = [run for level in ("*", "*/*") for run in glob.glob(f"{level}/checkpoint.pt", root_dir=path)]
                runs = " ".join(sorted(map(os.path.dirname, below)))
                advice = f"give a run in it: {runs}" if runs else "start the run anew"
                raise ValueError(f"it holds no checkpoint; {advice}")
            if name == "resume" and not cls.can_be_written(path):
                raise ValueError("it cannot be written")
            run = cls(path)
            return run, run.load(args_class)
        except filelock.Timeout:
            refuse(flag(name, path), "another process holds it; wait for its end")
        except (OSError, ValueError) as error:
            refuse(flag(name, path), getattr(error, "strerror", None) or error)

    @staticmethod
    def can_be_written(path: str) -> bool:
        """Says whether this user may write a run's directory and its lock, which another user may have made."""
        lock = os.path.join(path, "run.lock")
        return os.access(path, os.W_OK) and (os.access(lock, os.W_OK) or not os.path.exists(lock))

    def close(self) -> None:
        """Lets go of the directory, for another process or object to open it."""
        self.lock.release()

    def load(self, args_class: type) -> dict:
        """Returns the checkpoint. Raises ValueError if it is not one of a script with these arguments."""
        import torch

        try:
            with zipfile.ZipFile(self.checkpoint) as archive:
                whole = archive.testzip() is None  # torch.load itself takes flipped bytes for parameters
            state = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
            state["num_starts"] = state.get("num_starts", state.get("starts"))  # as it was called before
            state["args"] = {name: value for name, value in state["args"].items() if name not in RETIRED}
            others = state["args"].keys() ^ (args_class.__dataclass_fields__.keys() - OF_ONE_CALL)
            whole &= all(tensor.isfinite().all().item() for tensor in state["agent"].values())
            rollout = state["args"]["num_envs"] * state["args"]["num_steps"]
            whole &= state["global_step"] == state["iteration"] * rollout
        except Exception as error:  # a file that is no checkpoint can make them raise anything
            raise ValueError("its checkpoint is damaged, or not a checkpoint") from error
        if others:
            raise ValueError(f"its checkpoint is of another script, which differs in {', '.join(sorted(others))}")
        if not whole:
            raise ValueError("its checkpoint is damaged")
        return state

    def restore_agent(self, state: dict, agent, name: str = "evaluate") -> None:
        """Loads the parameters of the checkpoint `state`, or refuses the argument `name`."""
        try:
            agent.load_state_dict(state["agent"])
        except Exception as error:  # parameters of another network
            refuse(flag(name, self.path), f"its checkpoint does not fit this script ({type(error).__name__})")
        self.iteration = state["iteration"]

    def start(self, args, state: dict | None, agent, optimizer) -> int:
        """Starts afresh, or restores the checkpoint `state` into `agent` and `optimizer`; returns the iterations done.

        The emulators' state is not saved, so a resumed run starts new games. Points logged after the checkpoint are
        cut from the event files, for every reader of them.
        """
        import torch

        self.trains = True
        if state is not None:
            self.restore_agent(state, agent, "resume")
            optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})
            torch.set_rng_state(state["rng"][0])
            if len(state["rng"]) > 1 and next(agent.parameters()).is_cuda:
                torch.cuda.set_rng_state(state["rng"][1])
            self.num_starts = state["num_starts"]
            self.last_scores.extend(state["last_scores"])
            with self.reporting("the event file"):
                for name, size in self.event_files().items():
                    os.truncate(os.path.join(self.path, name), min(size, state["event_files"].get(name, 0)))
        self.describe(args, self.iteration * args.batch_size)
        return self.iteration

    def describe(self, args, step: int) -> None:
        """Writes the run's arguments and provenance to `args.json` and TensorBoard, and the layout of its page."""
        from torch.utils.tensorboard import summary

        about = {
            "command": command_line(args),
            "started_at_step": step,  # above 0 for a resumed run, which the command does not repeat
            # JSON has no infinity
            "args": {name: str(value) if value == math.inf else value for name, value in saved_args(args).items()},
            "provenance": provenance(inspect.getfile(type(args))),
        }
        with self.reporting("args.json"):
            write_text(os.path.join(self.path, "args.json"), json.dumps(about, indent=2))
        summaries = [summary.custom_scalars(TENSORBOARD_LAYOUT)]
        provenance_rows = {"command": about["command"], "started_at_step": step, **about["provenance"]}
        for tag, rows in (("hyperparameters", about["args"]), ("provenance", provenance_rows)):
            table = ["|name|value|", "|-|-|", *(f"|{name}|{value}|" for name, value in rows.items())]
            summaries.append(summary.text(tag, in_utf8("\n".join(table))))
        self.append_events([(step, summary) for summary in summaries])

    def log(self, step: int, scalars: dict[str, float], games: list[tuple[int, float, int]] = ()) -> None:
        """Writes scalars at an agent step, and games as (agent step, score, length) at the steps where they ended."""
        self.last_scores.extend(score for _, score, _ in games)
        mean = {"charts/mean_return_100": np.mean(self.last_scores)} if self.last_scores else {}
        points = [(end, "charts/episodic_return", score) for end, score, _ in games]
        points += [(end, "charts/episodic_length", length) for end, _, length in games]
        self.append_events(points + [(step, tag, value) for tag, value in {**mean, **scalars}.items()])

    def append_events(self, events: list[tuple]) -> None:
        """Appends to the event file of this start; if that fails, a new one begins with the next events."""
        with self.reporting("the event file"):
            try:
                self.event_file = self.event_file or EventFile(self.path)
                self.event_file.append(events)
            except OSError:
                self.event_file = None
                raise

    def log_evaluation(self, games: list[tuple[float, int]], stats: dict[str, float], step: int) -> None:
        """Writes games as (score, length) to `eval.csv`, and their statistics to an event file of their own.

        A resumed run keeps that file, which has nothing to do with how far the training had got.
        """
        path = os.path.join(self.path, "eval.csv")
        rows = [(step, number, *game) for number, game in enumerate(games, start=1)]
        header = [] if os.path.exists(path) else [("step", "game", "score", "length")]
        csv.writer(text := io.StringIO()).writerows([*header, *rows])
        with self.reporting("the evaluation"):
            EventFile(self.path, ".eval").append([(step, f"eval/{name}", value) for name, value in stats.items()])
            append(path, text.getvalue().encode())

    def save(self, args, iteration: int, agent, optimizer) -> None:
        """Writes a checkpoint, and sets the time at which the next is due."""
        import torch

        rng = [torch.get_rng_state()]
        if next(agent.parameters()).is_cuda:
            rng.append(torch.cuda.get_rng_state())
        progress = {"iteration": iteration, "global_step": iteration * args.batch_size}
        progress |= {"num_starts": self.num_starts + 1, "last_scores": list(self.last_scores)}
        learner = {"agent": agent.state_dict(), "optimizer": optimizer.state_dict()["state"], "rng": rng}
        self.write({"args": saved_args(args), **progress, **learner})
        self.checkpoint_due = time.perf_counter() + 60 * args.checkpoint_minutes

    def is_checkpoint_due(self) -> bool:
        return time.perf_counter() >= self.checkpoint_due

    def write(self, state: dict) -> None:
        """Writes a checkpoint beside the last one and renames it over: at every instant one of the two is whole."""
        import torch

        new = self.checkpoint + ".new"
        with self.reporting("the checkpoint"):
            try:
                event_files = self.event_files()
                with open(new, "wb") as file:
                    torch.save({"event_files": event_files, **state}, file)
                for name in (new, *(os.path.join(self.path, name) for name in event_files)):
                    with open(name, "rb+") as file:  # on the disk before the rename is, even if the power fails
                        os.fsync(file.fileno())
                os.replace(new, self.checkpoint)
                with contextlib.suppress(OSError):  # not every file system can; nothing is lost if it works without
                    directory = os.open(self.path, os.O_RDONLY)
                    try:
                        os.fsync(directory)
                    finally:
                        os.close(directory)
                self.iteration = state["iteration"]
            except (OSError, RuntimeError) as error:  # torch turns a full disk into a RuntimeError
                with contextlib.suppress(OSError):
                    os.remove(new)
                raise OSError(str(error)) from error

    @contextlib.contextmanager
    def reporting(self, what: str) -> Iterator[None]:
        """Says once that `what` cannot be written, and goes on."""
        try:
            yield
        except OSError as error:
            if what not in self.not_written:
                say(f"{self.path}: {what} cannot be written ({error}){'; the run goes on' if self.trains else ''}")
            self.not_written.add(what)

    def event_files(self) -> dict[str, int]:
        """Returns the size in bytes of each event file of the training, by name."""
        files = [file for file in os.scandir(self.path) if file.name.startswith("events.")]
        return {file.name: file.stat().st_size for file in files if not file.name.endswith(".eval")}


class EventFile:
    """A TensorBoard event file whose name sorts after those of all others in its directory, as readers take them.

    The files of torch's SummaryWriter are named by the clock alone. If that was set back, or two machines differ, the
    points of a resumed run would come before those that it goes on from.
    """

    def __init__(self, directory: str, suffix: str = ""):
        before = [re.match(r"events\.out\.tfevents\.(\d{10})\.", name) for name in os.listdir(directory)]
        second = max(int(time.time()), *(int(match[1]) + 1 for match in before if match), 0)
        name = f"events.out.tfevents.{second:010}.{platform.node()}.{os.getpid()}.0{suffix}"
        self.path = os.path.join(directory, name)

    def append(self, events: list[tuple]) -> None:
        """Appends (agent step, tag, value), or (agent step, summary): all of them, or none and OSError."""
        from tensorboard.compat.proto.event_pb2 import Event
        from tensorboard.summary.writer.record_writer import RecordWriter
        from torch.utils.tensorboard import summary

        now, writer = time.time(), RecordWriter(data := io.BytesIO())
        if not os.path.exists(self.path):
            writer.write(Event(wall_time=now, file_version="brain.Event:2").SerializeToString())
        for step, *given in events:
            shown = summary.scalar(*given) if len(given) == 2 else given[0]
            writer.write(Event(wall_time=now, step=step, summary=shown).SerializeToString())
        append(self.path, data.getvalue())


# ---------------------------------------------------------------------------------------------- beside the loop
class StopSignal:
    """Notes the first SIGINT, SIGTERM or SIGHUP in `number`, for a clean end; one that comes later ends at once.

    Later is a second or more: launchers send the same signal to a process and to its group, which it is in. A signal
    that is ignored when the script starts stays ignored, as after `nohup`.
    """

    number = 0

    def listen(self) -> None:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number is not None and signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self.note)

    def note(self, number: int, frame: object) -> None:
        if not self.number:
            self.number, self.since = number, time.monotonic()
            say("Stopping cleanly; another signal, at least a second from now, ends at once")
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
        left = timedelta(seconds=int((args.last_iteration - iteration) * args.batch_size / sps))
        score = f", score {np.mean(last_scores):.1f}" if last_scores else ""
        step, last_step = iteration * args.batch_size, args.last_iteration * args.batch_size
        line = f"step {step:,} of {last_step:,}, {sps:.0f} SPS{score}, {left} left"
        if os.isatty(2):
            columns = os.get_terminal_size(2).columns or 80
            line = line[: columns - 1]  # a line that wraps cannot be written over
            say(line, end="\n" if iteration == args.last_iteration else "")
        elif time.perf_counter() >= self.due:
            say(line)
            self.due = time.perf_counter() + 60


def saved_args(args) -> dict[str, object]:
    """Returns the arguments that belong to the run, not to one call of it."""
    return {name: value for name, value in vars(args).items() if name not in OF_ONE_CALL}


def command_line(args) -> str:
    """Returns the command that repeats the run: all that is not the default, and always game, seed and threads."""
    words, defaults = ["python", os.path.basename(inspect.getfile(type(args)))], vars(type(args)())
    for name, value in saved_args(args).items():
        if value != defaults[name] or name in ("env_id", "seed", "threads"):
            words.append(f"--{'no-' if value is False else ''}{name.replace('_', '-')}")
            if str(value).startswith("-"):  # a flag of its own, otherwise
                words[-1] += f"={value}"
            elif not isinstance(value, bool):
                words.append(str(value))
    return in_utf8(shlex.join(words))


def commit_of(script: str, checkout: str | None = None) -> str:
    """Returns the commit of this checkout, or of another; `-dirty` if it has changes, or does not hold the script."""
    here = checkout or os.path.dirname(os.path.abspath(__file__))
    clean = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # of another repository

    def git(*words: str) -> subprocess.CompletedProcess:
        texts = {"encoding": "utf-8", "errors": "replace"}
        return subprocess.run(["git", "-C", here, *words], capture_output=True, env=clean, **texts)

    def holds(path: str) -> bool:
        return git("ls-files", "--error-unmatch", os.path.abspath(path)).returncode == 0

    try:  # --exclude: the hash, not a tag
        described = git("describe", "--always", "--dirty", "--abbrev=40", "--exclude=*")
        own, script_in_it = checkout is not None or holds(__file__), holds(script)
    except OSError as error:
        return f"unknown ({error})"
    if described.returncode != 0:
        return f"unknown ({' '.join(described.stderr.split())})"
    if not own:  # a copy inside a repository of something else
        return f"unknown (the repository around {here} does not hold it)"
    commit = described.stdout.strip()
    return commit if script_in_it or commit.endswith("-dirty") else f"{commit}-dirty"


def provenance(script: str) -> dict[str, object]:
    """Returns the versions, commit, machine and threads, which a reader needs beside the arguments to repeat a run."""
    import torch

    with open(script, "rb") as file:
        text = hashlib.sha256(file.read()).hexdigest()
    versions = {}
    for package in ("torch", "gymnasium", "ale-py", "numpy", "opencv-python-headless", "tensorboard", "tyro"):
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:  # opencv-python in place of the headless one, for example
            versions[package] = "unknown"
    machine = f"{platform.platform()}, {available_cores()} cores, {kind_of_processor()}"
    waiting = (f"{name} {os.environ.get(name, 'not set')}" for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"))
    threads = f"{torch.get_num_threads()} torch, {', '.join(waiting)}"
    versions = {"python": platform.python_version(), **versions, "script": f"sha256 {text}"}
    return {"commit": commit_of(script), **versions, "machine": machine, "threads": threads}


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
    games = [[] for _ in range(envs.num_envs)]
    # Environment n plays the games n, n + N, n + 2N, … of all
    shares = [len(range(n, num_games, envs.num_envs)) for n in range(envs.num_envs)]
    missing = lambda: any(len(played) < share for played, share in zip(games, shares, strict=True))  # noqa: E731
    steps_left = 27_000 * max(shares)  # Atari's longest games; other environments may have no time limit
    while missing() and steps_left > 0 and not stop.number:
        steps_left -= 1
        obs, _, _, _, infos = envs.step(policy(obs))
        for n in np.flatnonzero(infos.get("_episode", False)):
            games[n].append((float(infos["episode"]["r"][n]), int(infos["episode"]["l"][n])))
    numbered = (divmod(number, envs.num_envs) for number in range(num_games))
    return [games[n][turn] for turn, n in numbered if turn < len(games[n])]


def evaluate(args, policy: Policy, run: RunDirectory, step: int, stop: StopSignal | None = None) -> None:
    """Plays `args.eval_episodes` games with the policy of agent step `step`, and prints and logs their scores."""
    import torch

    torch.set_num_threads(args.threads)
    envs = make_envs(args.env_id, args.num_envs, args.threads)  # however many games: so each has its number
    games = play(policy, envs, args.eval_episodes, [args.seed, 1], stop)
    envs.close()
    if stop is not None and stop.number:
        return
    if len(games) < args.eval_episodes:
        say(f"{args.eval_episodes - len(games)} of {args.eval_episodes} games did not end, they are left out")
    scores = np.array([score for score, _ in games] or [math.nan])
    std = scores.std(ddof=1) if len(scores) > 1 else 0.0
    stats = {"mean": scores.mean(), "std": std, "median": np.median(scores), "min": scores.min(), "max": scores.max()}
    run.log_evaluation(games, stats, step)
    tell(f"{len(games)} games at step {step:,}: {' '.join(f'{name} {value:.1f}' for name, value in stats.items())}")


def record_game(args, policy: Policy, run: RunDirectory, step: int, stop: StopSignal | None = None) -> None:
    """Plays one game into `videos/` of the run, with its score in the file's name; none if `stop` notes a signal."""
    path = os.path.join(run.path, "videos", f"step_{step}")
    with run.reporting("the video"):
        os.makedirs(os.path.dirname(path), exist_ok=True)
        try:
            with contextlib.closing(make_envs(args.env_id, 1, args.threads, video=path + ".webm")) as envs:
                scores = [score for score, _ in play(policy, envs, 1, [args.seed, 2], stop)]
            if stop is not None and stop.number:
                run.films_cut_short += 1
            else:
                result = f"score_{scores[0]:.10g}" if scores else "without_end"
                os.replace(path + ".webm", f"{path}_{result}.webm")
        finally:
            with contextlib.suppress(OSError):
                os.remove(path + ".webm")  # of a game cut short, or a full disk


def record_game_if_due(
    args, new_policy: Callable[[], Policy], run: RunDirectory, iteration: int, stop: StopSignal
) -> None:
    """Records a game at the start, at each quarter and at the end of the training, with `--capture-video`."""
    if args.capture_video and not stop.number and iteration in [args.num_iterations * k // 4 for k in range(5)]:
        record_game(args, new_policy(), run, iteration * args.batch_size, stop)


# --------------------------------------------------------------------------------------------------- command line
def open_run(args_class: type, description: str):
    """Chooses between training anew, resuming and evaluating, and refuses impossible calls with status 2.

    Returns the arguments, the environments, the run, its checkpoint (None for a new run) and the stop signal.
    """
    args = parse(args_class, description=description)
    stop = StopSignal()
    stop.listen()
    run = state = None
    name = "evaluate" if args.resume is None else "resume"
    if (directory := getattr(args, name)) is not None:
        run, state = RunDirectory.open(directory, name, args_class)
        args = parse(args_class, default=replace(args_class(**state["args"]), **of_this_call(args, name)))
        check_unchanged(args, state["args"], name)
    check(args)
    if args.resume is not None and state["iteration"] >= args.last_iteration:
        tell(finished_text(args, run, state))
        sys.exit()
    try:
        envs = make_envs(args.env_id, args.num_envs if args.evaluate is None else 1, args.threads)
        if args.capture_video:
            make_envs(args.env_id, 1, video="none yet").close()  # refused now, if it cannot be rendered
    except ValueError as error:
        refuse(flag("env_id", args.env_id), error)
    run = run or RunDirectory.make(args)  # last, so that nothing refused above leaves one behind
    warn_of_emulation(args)
    if args.evaluate is None:
        first, last = (state["global_step"] if state else 0), args.last_iteration * args.batch_size
        say(f"{run.path}: from step {first:,} to {last:,}")
    return args, envs, run, state, stop


def of_this_call(args, name: str) -> dict[str, object]:
    """Returns the arguments that a resumed or evaluated run does not bring along."""
    given = {"resume": args.resume, "evaluate": args.evaluate}
    if name == "evaluate":
        given |= {field: getattr(type(args)(), field) for field in ("capture_video", "eval_episodes", "threads")}
    return given


def check_unchanged(args, saved: dict[str, object], name: str) -> None:
    """Refuses arguments that a run cannot change. An evaluation may have another seed, for other games."""
    for field in ("env_id", "num_envs", "num_steps", "seed", "exp_name", "log_dir"):
        given, has = getattr(args, field), saved[field]
        if field == "log_dir":
            given, has = os.path.realpath(given), os.path.realpath(has)
        if given != has and not (field == "seed" and name == "evaluate"):
            refuse(flag(field, getattr(args, field)), f"the run has {saved[field]}, which cannot change")


def call_of(args, *words: str) -> str:
    """Returns the command that calls this script with other words, from any directory."""
    return shlex.join([sys.executable, os.path.abspath(inspect.getfile(type(args))), *words])


def finished_text(args, run: RunDirectory, state: dict) -> str:
    limit = "--total-timesteps" if state["iteration"] >= args.num_iterations else "--stop-at"
    text = f"{run.path} is finished up to {limit}, at step {state['global_step']}; a larger one takes it further"
    if limit == "--total-timesteps" and not os.path.exists(os.path.join(run.path, "eval.csv")):
        text += f"; it is not evaluated, do that with: {call_of(args, '--evaluate', os.path.abspath(run.path))}"
    return text


def finish(args, new_policy: Callable[[], Policy], run: RunDirectory, stop: StopSignal) -> typing.NoReturn:
    """Ends a call whose agent is trained or loaded: evaluates it, or says how to go on. Exits with its status."""
    run.trains = False
    path, step = os.path.abspath(run.path), run.iteration * args.batch_size
    done = args.evaluate is not None or run.iteration >= args.last_iteration
    wanted = args.evaluate is not None or (run.iteration == args.num_iterations and args.eval_episodes > 0)
    evaluated = False
    if wanted and not stop.number and not run.not_written:
        evaluate(args, new_policy(), run, step, stop)
        evaluated = not stop.number
        if args.evaluate is not None and args.capture_video:  # a training has filmed its last agent already
            record_game(args, new_policy(), run, step, stop)
    if not done and stop.number:
        stop_at = [] if args.stop_at is None else ["--stop-at", str(args.stop_at)]
        say(f"Stopped; go on with: {call_of(args, '--resume', path, *stop_at)}")
    elif wanted and not evaluated:
        say(f"Not evaluated; do that with: {call_of(args, '--evaluate', path)}")
    elif run.films_cut_short:
        say(f"Not filmed; do that with: {call_of(args, '--evaluate', path, '--capture-video')}")
    elif done and not wanted and run.iteration < args.num_iterations:
        say(f"At --stop-at; go on with: {call_of(args, '--resume', path)}")
    cut_short = wanted or not done or run.films_cut_short
    sys.exit(128 + stop.number if stop.number and cut_short else 1 if run.not_written else 0)


# Temporary: both names until the programs of benchmark/ use the new ones
usage_error, processor_kind, git_commit, check_bounds = refuse, kind_of_processor, commit_of, check
