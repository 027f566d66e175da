"""What each speed trick of the scripts gains on this machine: its plain form and the trick in turn, A B A B.

    python benchmark/tricks.py --threads 2

Prints a table: milliseconds of each form (median) and the median of the pairwise ratios with its quartiles. Sizes are
those of the thesis: minibatches of 256 screens for the update, 8 screens for a step of the rollout. Takes a minute.
"""

import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median, quantiles

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # the project's modules are found from any directory
from bookkeeping import processor_kind, tune_process

if __name__ == "__main__":
    tune_process()  # as the scripts do, before torch is imported

import numpy as np
import torch
import tyro
from ale_py.vector_env import AtariVectorEnv
from torch import nn
from torch.distributions import Categorical

MINIBATCH, NUM_ENVS, NUM_ACTIONS = 256, 8, 6


@dataclass
class Args:
    threads: int = 2
    """torch's threads, and as many for the games"""
    rounds: int = 15
    """pairs of measurements"""
    seconds: float = 0.1
    """time that one measurement repeats its form for, at least once"""


def nature_cnn(layout=torch.channels_last, dtype=torch.float32, convolve_last=False, inplace=True) -> nn.Sequential:
    """The Nature CNN with a head of logits and a value; the 512-unit layer as a `Linear` or as a 7×7 convolution."""
    torch.manual_seed(1)
    wide = [nn.Conv2d(64, 512, 7), nn.Flatten()] if convolve_last else [nn.Flatten(), nn.Linear(3136, 512)]
    layers = [nn.Conv2d(4, 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3)]
    layers = [part for layer in layers for part in (layer, nn.ReLU(inplace))]
    network = nn.Sequential(*layers, *wide, nn.ReLU(inplace), nn.Linear(512, NUM_ACTIONS + 1))
    return network.to(memory_format=layout, dtype=dtype)


def update(network: nn.Module, screens: torch.Tensor, dtype: torch.dtype = torch.float32, bf16=False) -> Callable:
    """Returns an update, with screens that are divided in `dtype`."""

    def run():
        network.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            output = network(screens.to(dtype).div_(255.0)).float()
        output.square().mean().backward()

    return run


def optimizer_step(fused: bool = True, late: bool = False, flush: bool = False) -> Callable:
    """Returns a step of Adam; `late` in a run, gradient clipping and a step with an eighth of the moments denormal.

    Those belong to dead units. They are 4 units of the last place, which 0.9 times 4 is rounded to again. Runs in a
    thread of its own, because the setting belongs to a thread and to those that it starts.
    """
    network = nature_cnn(torch.contiguous_format)
    thread = ThreadPoolExecutor(1, initializer=torch.set_flush_denormal, initargs=(flush,))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-9, fused=fused)

    def prepare():  # in that thread: this program's own would flush the numbers to 0
        network(torch.rand(2, 4, 84, 84)).sum().backward()
        optimizer.step()
        for parameter in network.parameters() if late else ():
            dead = parameter.numel() // 8
            parameter.grad.view(-1)[:dead] = 0
            optimizer.state[parameter]["exp_avg"].view(-1)[:dead] = 4 * 2.0**-149

    def run():
        if late:
            nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimizer.step()

    thread.submit(prepare).result()
    return lambda: thread.submit(run).result()


def forward(network: nn.Module, screens: torch.Tensor, mode=torch.inference_mode, bf16=False) -> Callable:
    """Returns a step of the network; one that is in bfloat16 already is not cast."""

    def run():
        with mode(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            network(screens.to(torch.bfloat16 if bf16 else torch.float32).div_(255.0))

    return run


def rollout_step(num_threads: int, groups: int = 1, **options) -> Callable:
    """Returns one agent step in 8 games. With two groups, the games of one run while the network serves the other.

    `num_threads` and `options` are ale-py's.
    """
    network, size = nature_cnn(), NUM_ENVS // groups
    options = {"num_threads": max(1, num_threads // groups), "use_fire_reset": False, **options}
    games = [AtariVectorEnv("breakout", size, **options) for _ in range(groups)]
    for envs in games:
        envs.reset(seed=1)
    actions, pool = np.ones(size, dtype=np.int64), ThreadPoolExecutor(1)
    pending = [pool.submit(envs.step, actions) for envs in games]

    def run():
        for i, envs in enumerate(games):
            screens = torch.from_numpy(pending[i].result()[0]).contiguous(memory_format=torch.channels_last)
            with torch.inference_mode():
                network(screens.float().div_(255.0))
            pending[i] = pool.submit(envs.step, actions)

    return run


def tricks(threads: int) -> dict[str, tuple[Callable, Callable]]:
    """Returns the pairs to compare: name, plain form, trick."""
    nhwc = torch.randint(0, 256, (4 * MINIBATCH, 84, 84, 4), dtype=torch.uint8)
    chosen = torch.randperm(4 * MINIBATCH)[:MINIBATCH]
    last = nhwc[:MINIBATCH].movedim(-1, 1)  # (B, 4, 84, 84) in channels-last layout
    first = last.contiguous()  # the same in torch's default layout
    network, late_step = nature_cnn(), partial(optimizer_step, late=True)
    usual = update(network, last)
    few, logits, rollout = last[:NUM_ENVS], torch.randn(NUM_ENVS, NUM_ACTIONS), rollout_step(threads)
    return {
        "update: channels-last layout": (update(nature_cnn(torch.contiguous_format), first), usual),
        "update: 512-unit layer as a 7×7 convolution (refused)": (usual, update(nature_cnn(convolve_last=True), last)),
        "update: ReLU in place": (update(nature_cnn(inplace=False), last), usual),
        "update: fused Adam": (optimizer_step(fused=False), optimizer_step()),
        "update: denormal numbers flushed to 0, late in a run": (late_step(flush=False), late_step(flush=True)),
        "minibatch: index_select for obs[indices]": (lambda: nhwc[chosen], lambda: nhwc.index_select(0, chosen)),
        "minibatch: .float().div_(255) for / 255": (lambda: last / 255.0, lambda: last.float().div_(255.0)),
        "update, bfloat16: screens cast to it at once, not by way of float32": (
            update(network, last, torch.float32, bf16=True),
            update(network, last, torch.bfloat16, bf16=True),
        ),
        "rollout: inference_mode": (forward(network, few, torch.no_grad), forward(network, few)),
        "rollout, bfloat16: weights cast once, not at each step": (
            forward(network, few, bf16=True),
            forward(nature_cnn(dtype=torch.bfloat16), few, bf16=True),
        ),
        "rollout: multinomial for Categorical": (
            lambda: Categorical(logits=logits).sample(),
            lambda: torch.multinomial(logits.log_softmax(-1).exp(), 1).squeeze(-1),
        ),
        "rollout: half the games run while the others act (refused)": (rollout, rollout_step(threads, groups=2)),
        "rollout: twice as many threads for the games (refused)": (rollout, rollout_step(2 * threads)),
        "rollout: games' threads bound to cores (refused)": (rollout, rollout_step(threads, thread_affinity_offset=0)),
    }


def time_of(form: Callable, seconds: float) -> float:
    """Returns the seconds that one call of `form` takes, averaged over at least `seconds`."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        form()
        calls += 1
    return (time.perf_counter() - start) / calls


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    torch.set_num_threads(args.threads)
    print(f"torch {torch.__version__}, {processor_kind()}, {args.threads} threads, {args.rounds} rounds\n")
    print("| trick | plain, ms | trick, ms | plain / trick (quartiles) |\n|-|-|-|-|")
    for name, pair in tricks(args.threads).items():
        measured = [[time_of(form, args.seconds) for form in pair] for _ in range(args.rounds + 1)]
        plain, trick = zip(*measured[1:])  # the first round warms up
        low, middle, high = quantiles([a / b for a, b in zip(plain, trick)], n=4)
        times = f"{1e3 * median(plain):.3g} | {1e3 * median(trick):.3g}"
        print(f"| {name} | {times} | {middle:.2f} ({low:.2f} to {high:.2f}) |")


if __name__ == "__main__":
    main()
