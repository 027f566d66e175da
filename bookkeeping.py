"""A stand-in for the house's bookkeeping.py: the small helpers that benchmark/ takes from it."""

import contextlib
import os
import sys
from pathlib import Path
from typing import NoReturn


def available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def say(text: str, end: str = "\n") -> None:
    with contextlib.suppress(OSError):
        if sys.stderr is not None:
            print(text, end=end, file=sys.stderr, flush=True)


def refuse(given: str, advice: object) -> NoReturn:
    say(" ".join(f"{given}: {advice}".split()))
    sys.exit(2)


def write_text(path: str | Path, text: str) -> None:
    path = Path(path)
    new = path.with_name(path.name + ".new")
    new.write_text(text, encoding="utf-8")
    os.replace(new, path)
