"""What several test files share: the scripts, names of tiny environments, and what a run has logged."""

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import acppo_atari
import ppo_atari
from wrappers import make_envs

ROOT = Path(__file__).parent.parent
SCRIPTS = {"ppo": ppo_atari, "acppo": acppo_atari}
# For tests that start many processes: tests/test_siblings.py sees to it that what they test is the same in both
ONE_IN_THE_PLAIN_RUN = [acppo_atari, pytest.param(ppo_atari, marks=pytest.mark.slow)]
MEASURED_IN_SECONDS = ("charts/SPS", "time/")  # what two equal runs do not share
TINY_PIXELS = "tiny_envs:TinyPixels-v0"
SHORT_CARTPOLE = "tiny_envs:ShortCartPole-v0"


@pytest.fixture(params=SCRIPTS.values(), ids=SCRIPTS)
def script(request):
    """Each of the two training scripts, as a module."""
    return request.param


def scalars(run_dir) -> dict[str, list[tuple[int, float]]]:
    """Returns what a run logged, read with TensorBoard's own reader: tag → [(step, value), …], all points."""
    reader = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})
    reader.Reload()
    return {tag: [(event.step, event.value) for event in reader.Scalars(tag)] for tag in reader.Tags()["scalars"]}


def values(logged: dict, tag: str) -> np.ndarray:
    return np.array([value for _, value in logged[tag]])


def train(script, run_dir, **arguments) -> dict[str, list[tuple[int, float]]]:
    """Trains in this process without the checks of the command line, and returns what was logged."""
    args = script.Args(**{"threads": 1, **arguments})
    run_dir = Path(run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    script.train(args, make_envs(args.env_id, args.num_envs, args.threads), script.RunDirectory(str(run_dir)))
    return scalars(run_dir)


def run_script(script, *flags: str, cwd: Path) -> subprocess.CompletedProcess:
    """Runs a script as a user would, in an empty directory, with the tests' environments importable."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "tests"), "COLUMNS": "200"}
    command = [sys.executable, script.__file__, *flags]
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture
def call_main(monkeypatch, capfd):
    """Calls a script's `main` in this process, for what ends before it trains: (exit status, stdout, stderr)."""

    def call(script, *flags: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [script.__file__, *flags])
        monkeypatch.setattr(threading, "excepthook", threading.excepthook)  # which main replaces
        handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            script.main()
            status = 0
        except SystemExit as ended:
            status = ended.code
        for number, handler in handlers.items():
            signal.signal(number, handler)
        return status, *capfd.readouterr()

    return call
