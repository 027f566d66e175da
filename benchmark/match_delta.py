"""Finds the δ of the variant `product`: the bound at which it clips as many samples as PPO does.

    python benchmark/match_delta.py --games Phoenix Qbert

The thesis's product-only objective (section 3.1) bounds abs((ρ - 1)Â) by δ alone, and the thesis gives no δ. Held
against PPO it is fair where both clip the same share of samples, so: PPO and the product for some δ are trained for
the first 50 iterations of the full schedule, `losses/clipfrac` is averaged over them, and δ is where the product's
clip fraction, linear in log δ between the tried ones, is PPO's. Prints a table; a run takes four minutes at 210
steps/s.
"""

import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

ROOT = Path(__file__).resolve().parent.parent
PPO = ("ppo_atari.py",)


def clip_fraction(script: str, *flags: str, steps: int) -> float:
    """Trains in a process of its own, with one thread, and returns the mean of `losses/clipfrac`."""
    with tempfile.TemporaryDirectory() as directory:
        command = [sys.executable, str(ROOT / script), *flags, "--stop-at", str(steps), "--threads", "1"]
        subprocess.run([*command, "--log-dir", directory], check=True, stderr=subprocess.DEVNULL)
        (run_dir,) = Path(directory).iterdir()
        reader = EventAccumulator(str(run_dir), size_guidance={"scalars": 0})  # 0: every point
        reader.Reload()
        return float(np.mean([event.value for event in reader.Scalars("losses/clipfrac")]))


def interpolate(deltas: list[float], fractions: list[float], wanted: float) -> float:
    """Returns the δ at which the clip fraction is `wanted`, NaN where that is beyond the tried ones.

    The larger δ, the fewer samples are clipped; noise may hide it, so the pairs are sorted by their fraction.
    """
    fractions, log_deltas = zip(*sorted(zip(fractions, np.log(deltas))))
    return float(np.exp(np.interp(wanted, fractions, log_deltas, left=np.nan, right=np.nan)))


def main(
    games: tuple[str, ...] = ("Phoenix", "Qbert"),
    deltas: tuple[float, ...] = (0.02, 0.04, 0.08),
    seed: int = 1,
    iterations: int = 50,
    jobs: int = os.cpu_count() or 1,
) -> None:
    """Prints the clip fractions of each game and the matching δ, and its geometric mean over the games.

    Args:
        games: names as for the scripts.
        deltas: bounds to try, above 0.
        seed: of every run.
        iterations: rollouts of 1,024 agent steps with their updates.
        jobs: runs at once.
    """
    variants = [PPO, *(("acppo_atari.py", "--c", "inf", "--clip-coef", str(delta)) for delta in deltas)]
    with ThreadPoolExecutor(jobs) as pool:

        def start(game: str, variant: tuple[str, ...]):
            flags = ("--env-id", game, "--seed", str(seed))
            return pool.submit(clip_fraction, *variant, *flags, steps=1024 * iterations)

        pending = {game: [start(game, variant) for variant in variants] for game in games}
    print("| game | ppo | " + " | ".join(f"δ = {delta:g}" for delta in deltas) + " | matching δ |")
    print("|-" * (3 + len(deltas)) + "|")
    matches = []
    for game, results in pending.items():
        ppo, *products = (result.result() for result in results)
        matches.append(interpolate(list(deltas), products, ppo))
        cells = [game, *(f"{fraction:.4f}" for fraction in (ppo, *products)), f"{matches[-1]:.4f}"]
        print("| " + " | ".join(cells) + " |")
    print(f"\nGeometric mean over the games: δ = {np.exp(np.mean(np.log(matches))):.4f}")


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
