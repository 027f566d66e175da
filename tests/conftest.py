"""Helpers of several test files: the scripts, in this process and in their own, and the logs of a run."""

import contextlib
import itertools
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.summary.writer import event_file_writer

import acppo_atari
import bookkeeping
import ppo_atari
import siblings
from wrappers import make_envs

ROOT = Path(__file__).parent.parent
SCRIPTS = {"ppo": ppo_atari, "acppo": acppo_atari}
MEASURED_IN_SECONDS = ("charts/SPS", "time/")  # two equal runs differ in these
TINY_PIXELS = "tiny_envs:TinyPixels-v0"
SHORT_CARTPOLE = "tiny_envs:ShortCartPole-v0"
SMALL = {"num_envs": 4, "num_steps": 32, "threads": 1}
PATIENCE = 600  # seconds that a process is waited for: they end a test that hangs, and decide nothing else


@pytest.fixture
def script(request):
    """A training script: one in the plain suite, because tests/test_siblings.py holds the other to the same lines."""
    return request.param


@pytest.fixture
def each_script(request):
    """Both scripts in the plain suite too, for the mathematics and the smoke runs."""
    return request.param


@pytest.fixture(autouse=True)
def event_files_in_order(monkeypatch):
    """Files of starts within one second, which only a test makes, sort in their order: TensorBoard names them by it."""
    seconds = itertools.count(int(time.time()) + 1000)
    monkeypatch.setattr(event_file_writer, "time", SimpleNamespace(time=lambda: next(seconds)))


PARAMS = {
    "script": {"argvalues": [acppo_atari, pytest.param(ppo_atari, marks=pytest.mark.slow)], "ids": ["acppo", "ppo"]},
    "each_script": {"argvalues": list(SCRIPTS.values()), "ids": list(SCRIPTS)},
}


def pytest_generate_tests(metafunc):
    """Gives the two fixtures their scripts, or that of `--script` alone."""
    given = metafunc.config.stash.get(siblings.GIVEN, None)
    for name in PARAMS.keys() & set(metafunc.fixturenames):
        params = PARAMS[name] if given is None else {"argvalues": [given], "ids": [given.__name__]}
        metafunc.parametrize(name, **params, indirect=True)


# ---------------------------------------------------------------------------------------------- the logs of a run
def scalars(run_dir) -> dict[str, list[tuple[int, float]]]:
    """Returns what a run logged, read with TensorBoard's own reader: tag → [(step, value), …], all points."""
    reader = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    reader.Reload()
    return {tag: [(event.step, event.value) for event in reader.Scalars(tag)] for tag in reader.Tags()["scalars"]}


def values(logged: dict, tag: str) -> np.ndarray:
    return np.array([value for _, value in logged[tag]])


def reproducible(logged: dict) -> dict:
    """What two equal runs log alike."""
    return {tag: points for tag, points in logged.items() if not tag.startswith(MEASURED_IN_SECONDS)}


def run_dir_in(directory: Path) -> Path:
    """The one run's directory in a log directory."""
    (run_dir,) = directory.iterdir()
    return run_dir


def checkpoint_of(run_dir: Path) -> dict:
    return torch.load(run_dir / "checkpoint.pt", weights_only=True)


def cells(markdown: str) -> list[list[str]]:
    """The cells of the tables in a text, row by row."""
    lines = [line for line in markdown.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


# ------------------------------------------------------------------------------------------------------ in this process
@contextlib.contextmanager
def open_run(script, path):
    """Holds a run's directory for the body of a `with`."""
    run = script.RunDirectory(str(path))
    try:
        yield run
    finally:
        run.lock.release()


def train(script, run_dir, **arguments) -> dict[str, list[tuple[int, float]]]:
    """Trains without the checks of the command line, and returns the logged scalars."""
    args = script.Args(**{"threads": 1, **arguments})
    run_dir = Path(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    with open_run(script, run_dir) as run:
        script.train(args, make_envs(args.env_id, args.num_envs, args.threads), run)
    return scalars(run_dir)


def flags_of(**arguments) -> list[str]:
    return [word for name, value in arguments.items() for word in (f"--{name.replace('_', '-')}", str(value))]


class Ended(NamedTuple):
    """How a call of a script ended; `err` is without the lines that say where a run is and how far."""

    status: int
    out: str
    err: str

    @classmethod
    def with_output(cls, status: int, out: str, err: str) -> "Ended":
        lines = err.splitlines(keepends=True)
        return cls(status, out, "".join(line for line in lines if not re.match(r"step |\S+: from step ", line)))


@pytest.fixture
def call_main(monkeypatch, capfd, tmp_path):
    """Calls the `main` of a script, or a command, in this process, which stays as it was, from the test's directory."""
    monkeypatch.chdir(tmp_path)

    def call(script, *flags: str) -> Ended:
        monkeypatch.setattr(sys, "argv", [script.__file__, *flags])
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        opened, status = [], 0

        class RunDirectory(bookkeeping.RunDirectory):
            def __init__(self, path: str):
                super().__init__(path)
                opened.append(self)

        with monkeypatch.context() as patch, warnings.catch_warnings(record=True) as shown:
            patch.setattr(bookkeeping, "RunDirectory", RunDirectory)
            patch.setattr(threading, "excepthook", threading.excepthook)  # which `open_run` sets
            warnings.resetwarnings()  # to those that a process of its own would print
            for hidden in (DeprecationWarning, PendingDeprecationWarning, ImportWarning, ResourceWarning):
                warnings.simplefilter("ignore", hidden)
            try:
                script.main()
            except SystemExit as ended:
                status = ended.code or 0
            finally:
                for run in opened:
                    run.lock.release()
                for number, handler in handlers.items():
                    signal.signal(number, handler)
        out, err = capfd.readouterr()
        return Ended.with_output(status, out, err + "".join(f"{warning.message}\n" for warning in shown))

    return call


# -------------------------------------------------------------------------------------------------- as a process
def environment(directory: Path = ROOT / "tests", **variables: str) -> dict[str, str]:
    """The variables of a process that imports from a directory, and from the project, from anywhere."""
    return {**os.environ, "PYTHONPATH": f"{directory}{os.pathsep}{ROOT}", **variables}


class Process(subprocess.Popen):
    """A script as a user starts it, with the tests' environments importable."""

    def __init__(self, script, *flags: str, cwd: Path, file_size: int | None = None):
        """Starts it; no file that it writes can grow beyond `file_size` bytes, as if the disk were full."""

        def prepare() -> None:
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # which a suite in the background of a script ignores
            resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE, PATIENCE))  # an endless run must not outlive its tests
            if file_size is not None:
                resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))

        super().__init__(
            [sys.executable, script.__file__, *flags],
            cwd=cwd,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=prepare,
        )

    def wait_for(self, condition) -> None:
        """Waits for something that the process does, which must not end without it."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert self.poll() is None, self.communicate()
            assert time.monotonic() < deadline
            time.sleep(0.05)

    def end(self) -> Ended:
        """Waits for its end."""
        out, err = self.communicate(timeout=PATIENCE)
        return Ended.with_output(self.returncode, out, err)


@pytest.fixture
def start(tmp_path):
    """Starts a script as a process in the test's own directory; with the test, the process ends."""
    started = []

    def start_script(script, *flags: str, **options) -> Process:
        started.append(Process(script, *flags, cwd=tmp_path, **options))
        return started[-1]

    yield start_script
    for process in started:
        process.kill()
        process.communicate()
