"""Finds the bound at which one variant clips as many samples, or moves the policy as far, as another.

    python benchmark/match.py --on clipfrac --games Phoenix Qbert
    python benchmark/match.py --on kl --games Qbert --iterations 200

`--on clipfrac` finds the δ of the variant `product`. The thesis's product-only objective (section 3.1) bounds
abs((ρ - 1)Â) by δ alone, and the thesis gives no δ; held against PPO it is fair if both clip the same share of samples.
`--on kl` finds the ε of the variant `ppo-matched`: PPO whose KL between policy updates is AC-PPO's, so that the two
differ by the adaptation and not by smaller steps.

The one that is matched and the other at each of `--bounds` are trained for the first iterations of the full schedule,
`losses/clipfrac` or `losses/kl` is averaged over them, and the bound is where the mean, linear in the bound's log
between the tried ones, is the matched one's. The answer holds for these iterations. Prints a table; 50 iterations
take four minutes a run at 210 steps/s. Exit status: 0 all games have a match, 1 some have none, 2 bad input.
"""

import itertools
import math
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from benchmark.collect import ROOT, read_curve, read_events
from benchmark.readme import markdown
from bookkeeping import available_cores, parse, refuse, say, tell


@dataclass
class Search:
    matched: tuple[str, ...]  # script and flags
    tried: tuple[str, ...]  # the same; its `--clip-coef` is looked for
    symbol: str
    bounds: tuple[float, ...]
    rises: bool  # with the bound


# By the column of curves.csv whose mean is to be equal
SEARCHES = {
    "clipfrac": Search(("ppo_atari.py",), ("acppo_atari.py", "--c", "inf"), "δ", (0.01, 0.02, 0.04, 0.08), False),
    "kl": Search(("acppo_atari.py",), ("ppo_atari.py",), "ε", (0.04, 0.06, 0.08), True),
}


@dataclass
class Args:
    on: str
    """the curve whose mean is to be equal: clipfrac or kl"""
    games: tuple[str, ...] = ("Qbert",)
    """games, named as for the scripts"""
    bounds: tuple[float, ...] = ()
    """bounds to try, above 0, two or more; by default 0.01 to 0.08 for clipfrac, 0.04 to 0.08 for kl"""
    seed: int = 1
    """seed of every run"""
    iterations: int = 50
    """rollouts of 1,024 agent steps with their updates"""
    bf16: bool = False
    """train in bfloat16, as the runs that are compared"""
    jobs: int = available_cores()
    """runs at once, each with one thread"""


def mean_over_training(column: str, script: str, *flags: str, steps: int) -> float:
    """Trains in a process of its own, with one thread, and returns the mean of a column of curves.csv.

    Raises ChildProcessError with the last line that the script has said if it ends with another status than 0.
    """
    with tempfile.TemporaryDirectory() as directory:
        command = [sys.executable, str(ROOT / script), *flags, "--stop-at", str(steps), "--threads", "1"]
        command += ["--eval-episodes", "0", "--log-dir", directory]
        run = subprocess.run(command, stderr=subprocess.PIPE, text=True, encoding="utf-8", errors="replace")
        if run.returncode:
            raise ChildProcessError((run.stderr.strip().splitlines() or [f"exit status {run.returncode}"])[-1])
        (run_dir,) = Path(directory).iterdir()
        return float(read_curve(read_events(run_dir))[column].mean())


def interpolate(bounds: list[float], means: list[float], wanted: float, rises: bool) -> float:
    """Returns the bound at which the mean is `wanted`; NaN if that is beyond the tried ones, or if the means do not
    rise (or fall) with the bound, so that noise is larger than the effect."""
    bounds, means = map(np.array, zip(*sorted(zip(bounds, means))))
    sign = 1 if rises else -1
    if (np.diff(sign * means) <= 0).any():
        return math.nan
    return float(np.exp(np.interp(sign * wanted, sign * means, np.log(bounds), left=np.nan, right=np.nan)))


def main() -> None:
    args = parse(Args, description=__doc__)
    if args.on not in SEARCHES:
        refuse(f"--on {args.on}", f"give {' or '.join(SEARCHES)}")
    search = SEARCHES[args.on]
    bounds = args.bounds or search.bounds
    rules = [
        ("games", bool(args.games), "give at least one"),
        ("bounds", len(set(bounds)) > 1 and all(0 < bound < 1e30 for bound in bounds), "give two or more above 0"),
        ("iterations", args.iterations > 0, "give a whole number above 0"),
        ("jobs", args.jobs > 0, "give a whole number above 0"),
    ]
    for name, works, advice in rules:
        if not works:
            refuse(f"--{name} {getattr(args, name)}", advice)
    contenders = [search.matched, *((*search.tried, "--clip-coef", str(bound)) for bound in bounds)]
    common = ("--seed", str(args.seed), *(["--bf16"] if args.bf16 else []))
    steps, pairs = 1024 * args.iterations, list(itertools.product(args.games, contenders))
    with ThreadPoolExecutor(args.jobs) as pool:
        runs = [
            pool.submit(mean_over_training, args.on, *contender, "--env-id", game, *common, steps=steps)
            for game, contender in pairs
        ]
        try:
            means = {pair: run.result() for pair, run in zip(pairs, runs)}
        except ChildProcessError as error:
            pool.shutdown(cancel_futures=True)
            say(str(error))
            sys.exit(2)
    table, found = [], {}
    for game in args.games:
        wanted, *tried = (means[game, contender] for contender in contenders)
        found[game] = interpolate(list(bounds), tried, wanted, search.rises)
        table.append([game, *(f"{mean:.3g}" for mean in (wanted, *tried)), f"{found[game]:.4f}"])
    names = [f"{search.symbol} = {bound:g}" for bound in bounds]
    tell(markdown(["game", " ".join(search.matched), *names, f"matching {search.symbol}"], table))
    if without := [game for game, bound in found.items() if math.isnan(bound)]:
        advice = f"the {args.on} to match is not between those of the tried bounds; give other --bounds, or more "
        say(f"{', '.join(without)}: {advice}--iterations")
        sys.exit(1)
    tell(f"Geometric mean over the games: {search.symbol} = {np.exp(np.mean(np.log(list(found.values())))):.4f}")


if __name__ == "__main__":
    main()
