"""Finds the bound at which one variant clips as many samples, or moves the policy as far, as another.

    python benchmark/match.py --on kl --games Qbert --iterations 200

`--on clipfrac` finds the δ of the variant `product`. The thesis's product-only objective (section 3.1) bounds
abs((ρ - 1)Â) by δ and nothing else, and the thesis gives no δ; a comparison with PPO is fair if both clip the same
share of samples. `--on kl` finds the ε of the variant `ppo-matched`: PPO whose KL between policy updates is AC-PPO's,
so that the two differ by the adaptation and not by smaller steps.

The matched variant, and the other at each of `--bounds`, are trained for the first iterations of the full schedule.
The match is where the mean of the curve, linear in the bound's log, is the matched variant's, for these iterations.
"""

import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the project's modules are found from any directory
from benchmark.readme import markdown
from bookkeeping import NonNegativeInt, PositiveInt, available_cores, check_args

ROOT = Path(__file__).resolve().parent.parent

# The matched variant; the tried one, whose --clip-coef is looked for; its symbol; bounds; does the mean rise with them?
SEARCHES = {
    "clipfrac": (("ppo_atari.py",), ("acppo_atari.py", "--c", "inf"), "δ", (0.01, 0.02, 0.04, 0.08), False),
    "kl": (("acppo_atari.py",), ("ppo_atari.py",), "ε", (0.04, 0.06, 0.08), True),
}


@dataclass
class Args:
    on: Literal["clipfrac", "kl"]
    """the curve whose mean is to be equal"""
    games: tuple[str, ...] = ("Qbert",)
    """games, named as for the scripts"""
    bounds: tuple[float, ...] = ()
    """bounds to try, above 0, two or more; by default 0.01 to 0.08 for clipfrac, 0.04 to 0.08 for kl"""
    seed: NonNegativeInt = 1
    """seed of every run"""
    iterations: PositiveInt = 50
    """rollouts of 1,024 agent steps with their updates"""
    bf16: bool = False
    """train in bfloat16, as the runs that are compared"""
    jobs: PositiveInt = available_cores()
    """runs at once, each with one thread"""

    def rules(self) -> list[tuple[str, bool, str]]:
        """Returns (argument, does it hold, advice) for the rule that its type does not say."""
        return [("bounds", not self.bounds or len(set(self.bounds)) > 1, "give two or more")]


def mean_over_training(on: str, script: str, *flags: str) -> float:
    """Trains in another process, and returns the mean of the curve `losses/ON`. Raises CalledProcessError."""
    with tempfile.TemporaryDirectory() as directory:
        common = ["--threads", "1", "--eval-episodes", "0", "--log-dir", directory]
        subprocess.run([sys.executable, str(ROOT / script), *flags, *common], check=True)
        (file,) = Path(directory).glob("*/events.out.tfevents*")
        reader = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()  # 0: every point
        return float(np.mean([event.value for event in reader.Scalars(f"losses/{on}")]))


def interpolate(bounds: list[float], means: list[float], wanted: float, rises: bool) -> float:
    """Returns the bound at which the mean is `wanted`; NaN if that is beyond the tried ones, or if the means do not
    rise (or fall) with the bounds, which are sorted: noise is larger than the effect then."""
    sign = 1 if rises else -1
    means = sign * np.array(means)
    found = np.exp(np.interp(sign * wanted, means, np.log(bounds), left=np.nan, right=np.nan))
    return float(found) if (np.diff(means) > 0).all() else np.nan


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    check_args(args)
    matched, tried, symbol, bounds, rises = SEARCHES[args.on]
    bounds = sorted(args.bounds or bounds)
    variants = [matched, *((*tried, "--clip-coef", str(bound)) for bound in bounds)]
    common = ["--seed", str(args.seed), "--stop-at", str(1024 * args.iterations), *(["--bf16"] if args.bf16 else [])]
    calls = [(args.on, *variant, "--env-id", game, *common) for game in args.games for variant in variants]
    with ThreadPoolExecutor(args.jobs) as pool:
        means = list(pool.map(lambda call: mean_over_training(*call), calls))
    by_game = dict(zip(args.games, np.reshape(means, (-1, len(variants)))))
    found = {game: interpolate(bounds, of_bounds, wanted, rises) for game, (wanted, *of_bounds) in by_game.items()}
    table = [[game, *(f"{mean:.3g}" for mean in by_game[game]), f"{found[game]:.4f}"] for game in found]
    names = [f"{symbol} = {bound:g}" for bound in bounds]
    print(markdown(["game", " ".join(matched), *names, f"matching {symbol}"], table))
    if without := [game for game in found if np.isnan(found[game])]:
        sys.exit(f"{', '.join(without)}: no match between the tried bounds; give other --bounds, or more --iterations")
    print(f"Geometric mean over the games: {symbol} = {np.exp(np.mean(np.log(list(found.values())))):.4f}")


if __name__ == "__main__":
    main()
