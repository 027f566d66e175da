"""Finds the δ of the variant `product`: the bound at which it clips as many samples as PPO does.

    python benchmark/match_delta.py --games Phoenix Qbert

The thesis's product-only objective (section 3.1) bounds abs((ρ - 1)Â) by δ alone, and the thesis gives no δ. Held
against PPO it is fair where both clip the same share of samples, so: PPO and the product for some δ are trained for
the first 50 iterations of the full schedule, `losses/clipfrac` is averaged over them, and δ is where the product's
clip fraction, linear in log δ between the tried ones, is PPO's. Prints a table; a run takes four minutes at 210
steps/s. Exit status: 0 all games have a match, 1 some have none, 2 bad input.
"""

import itertools
import math
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for wrappers.py, where nothing is installed
from wrappers import available_cores, refuse

ROOT = Path(__file__).resolve().parent.parent
PPO = ("ppo_atari.py",)


def clip_fraction(script: str, *flags: str, steps: int) -> float:
    """Trains in a process of its own, with one thread, and returns the mean of `losses/clipfrac`.

    Raises ChildProcessError with the last line that the script has said, where it ends with another status than 0.
    """
    with tempfile.TemporaryDirectory() as directory:
        command = [sys.executable, str(ROOT / script), *flags, "--stop-at", str(steps), "--threads", "1"]
        run = subprocess.run([*command, "--log-dir", directory], stderr=subprocess.PIPE, text=True)
        if run.returncode:
            raise ChildProcessError((run.stderr.strip().splitlines() or [f"exit status {run.returncode}"])[-1])
        (run_dir,) = Path(directory).iterdir()
        reader = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})  # 0: every point
        reader.Reload()
        return float(np.mean([event.value for event in reader.Scalars("losses/clipfrac")]))


def interpolate(deltas: list[float], fractions: list[float], wanted: float) -> float:
    """Returns the δ at which the clip fraction is `wanted`; NaN where that is beyond the tried ones, or where the
    fractions do not fall as δ grows, so that noise is larger than what is looked for."""
    deltas, fractions = map(np.array, zip(*sorted(zip(deltas, fractions))))
    if (np.diff(fractions) >= 0).any():
        return math.nan
    return float(np.exp(np.interp(-wanted, -fractions, np.log(deltas), left=np.nan, right=np.nan)))


def main(
    games: tuple[str, ...] = ("Phoenix", "Qbert"),
    deltas: tuple[float, ...] = (0.02, 0.04, 0.08),
    seed: int = 1,
    iterations: int = 50,
    jobs: int = available_cores(),
) -> None:
    """Prints the clip fractions of each game and the matching δ, and its geometric mean over the games.

    Args:
        games: names as for the scripts.
        deltas: bounds to try, above 0, two or more.
        seed: of every run.
        iterations: rollouts of 1,024 agent steps with their updates.
        jobs: runs at once.
    """
    rules = [
        ("games", games, bool(games), "give at least one"),
        ("deltas", deltas, len(set(deltas)) > 1 and all(0 < x < 1e30 for x in deltas), "give two or more above 0"),
        ("iterations", iterations, iterations > 0, "give a whole number above 0"),
        ("jobs", jobs, jobs > 0, "give a whole number above 0"),
    ]
    for name, given, works, advice in rules:
        if not works:
            refuse(name, given, advice)
    variants = [PPO, *(("acppo_atari.py", "--c", "inf", "--clip-coef", str(delta)) for delta in deltas)]
    pairs = list(itertools.product(games, variants))
    with ThreadPoolExecutor(jobs) as pool:
        runs = [
            pool.submit(clip_fraction, *variant, "--env-id", game, "--seed", str(seed), steps=1024 * iterations)
            for game, variant in pairs
        ]
        try:
            fractions = {pair: run.result() for pair, run in zip(pairs, runs)}
        except ChildProcessError as error:
            pool.shutdown(cancel_futures=True)
            print(error, file=sys.stderr)
            sys.exit(2)
    print("| game | ppo | " + " | ".join(f"δ = {delta:g}" for delta in deltas) + " | matching δ |")
    print("|-" * (3 + len(deltas)) + "|")
    matches = {}
    for game in games:
        ppo, *products = (fractions[game, variant] for variant in variants)
        matches[game] = interpolate(list(deltas), products, ppo)
        cells = [game, *(f"{fraction:.4f}" for fraction in (ppo, *products)), f"{matches[game]:.4f}"]
        print("| " + " | ".join(cells) + " |")
    if without := [game for game, delta in matches.items() if math.isnan(delta)]:
        advice = "PPO's clip fraction is not between those of the product; give other --deltas, or more --iterations"
        print(f"{', '.join(without)}: {advice}", file=sys.stderr)
        sys.exit(1)
    print(f"\nGeometric mean over the games: δ = {np.exp(np.mean(np.log(list(matches.values())))):.4f}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
