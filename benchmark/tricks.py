"""What each speed trick of the scripts gains on this machine, alone: its plain form and the trick in turn, A B A B.

    python benchmark/tricks.py --threads 2

Prints a table: milliseconds of each form (median) and the median of the pairwise ratios with its quartiles. Sizes are
those of the thesis: minibatches of 256 screens for the update, 8 screens for a step of the rollout. Takes a minute.
"""

import copy
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from statistics import median, quantiles

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import kind_of_processor, parse, tell, tune_process

if __name__ == "__main__":
    tune_process()  # as the scripts do, before torch is imported

import numpy as np
import torch
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


def nature_cnn(convolve_last: bool = False, inplace: bool = True) -> nn.Sequential:
    """The Nature CNN with a head of logits and a value; the 512-unit layer as a `Linear` or as a 7×7 convolution."""
    torch.manual_seed(1)
    wide = [nn.Conv2d(64, 512, 7), nn.Flatten()] if convolve_last else [nn.Flatten(), nn.Linear(3136, 512)]
    layers = [nn.Conv2d(4, 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3)]
    layers = [part for layer in layers for part in (layer, nn.ReLU(inplace))]
    return nn.Sequential(*layers, *wide, nn.ReLU(inplace), nn.Linear(512, NUM_ACTIONS + 1))


def update(network: nn.Module, screens: torch.Tensor) -> Callable:
    def run():
        network.zero_grad()
        network(screens.float().div_(255.0)).square().mean().backward()

    return run


def update_bf16(network: nn.Module, screens: torch.Tensor, dtype: torch.dtype) -> Callable:
    """Returns an update under `--bf16`, with screens that are divided in `dtype`."""

    def run():
        network.zero_grad()
        with torch.autocast("cpu", torch.bfloat16):
            output = network(screens.to(dtype).div_(255.0)).float()
        output.square().mean().backward()

    return run


def optimizer_step(fused: bool) -> Callable:
    network = nature_cnn()
    network(torch.rand(2, 4, 84, 84)).sum().backward()
    return torch.optim.Adam(network.parameters(), lr=1e-9, fused=fused).step


def late_optimizer_step(flush: bool) -> Callable:
    """Returns gradient clipping and a step of Adam as late in a run: an eighth of the first moments is denormal.

    Those belong to dead units. They are 4 units of the last place, which 0.9 times 4 is rounded to again. Runs in a
    thread of its own, because the setting belongs to a thread and to those that it starts.
    """
    network, thread = nature_cnn(), ThreadPoolExecutor(1, initializer=torch.set_flush_denormal, initargs=(flush,))
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-9, fused=True)

    def prepare():
        network(torch.rand(2, 4, 84, 84)).sum().backward()
        optimizer.step()
        for parameter in network.parameters():
            dead = parameter.numel() // 8
            parameter.grad.view(-1)[:dead] = 0
            optimizer.state[parameter]["exp_avg"].view(-1)[:dead] = 4 * 2.0**-149

    def run():
        nn.utils.clip_grad_norm_(network.parameters(), 0.5)
        optimizer.step()

    thread.submit(prepare).result()
    return lambda: thread.submit(run).result()


def forward(network: nn.Module, screens: torch.Tensor, mode: Callable) -> Callable:
    def run():
        with mode():
            network(screens.float().div_(255.0))

    return run


def forward_bf16(network: nn.Module, screens: torch.Tensor) -> Callable:
    """Returns a step of the network under `--bf16`; a network that is in bfloat16 already is not cast."""

    @torch.inference_mode()
    def run():
        with torch.autocast("cpu", torch.bfloat16):
            network(screens.to(torch.bfloat16).div_(255.0))

    return run


def rollout_step(num_threads: int, groups: int = 1, **options) -> Callable:
    """Returns one agent step in 8 games. With two groups, the games of one run while the network serves the other.

    `num_threads` and `options` are ale-py's.
    """
    network = nature_cnn().to(memory_format=torch.channels_last)
    size = NUM_ENVS // groups
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
    channels_last = nature_cnn().to(memory_format=torch.channels_last)
    convolved = nature_cnn(convolve_last=True).to(memory_format=torch.channels_last)
    out_of_place = nature_cnn(inplace=False).to(memory_format=torch.channels_last)
    logits = torch.randn(NUM_ENVS, NUM_ACTIONS)
    return {
        "update: channels-last layout": (update(nature_cnn(), first), update(channels_last, last)),
        "update: 512-unit layer as a 7×7 convolution (refused)": (update(channels_last, last), update(convolved, last)),
        "update: ReLU in place": (update(out_of_place, last), update(channels_last, last)),
        "update: fused Adam": (optimizer_step(fused=False), optimizer_step(fused=True)),
        "update: denormal numbers flushed to 0, late in a run": (late_optimizer_step(False), late_optimizer_step(True)),
        "minibatch: index_select for obs[indices]": (lambda: nhwc[chosen], lambda: nhwc.index_select(0, chosen)),
        "minibatch: .float().div_(255) for / 255": (lambda: last / 255.0, lambda: last.float().div_(255.0)),
        "update, bfloat16: screens cast to it at once, not by way of float32": (
            update_bf16(channels_last, last, torch.float32),
            update_bf16(channels_last, last, torch.bfloat16),
        ),
        "rollout: inference_mode for no_grad": (
            forward(channels_last, last[:NUM_ENVS], torch.no_grad),
            forward(channels_last, last[:NUM_ENVS], torch.inference_mode),
        ),
        "rollout, bfloat16: weights cast once, not at each step": (
            forward_bf16(channels_last, last[:NUM_ENVS]),
            forward_bf16(copy.deepcopy(channels_last).bfloat16(), last[:NUM_ENVS]),
        ),
        "rollout: multinomial for Categorical": (
            lambda: Categorical(logits=logits).sample(),
            lambda: torch.multinomial(logits.log_softmax(-1).exp(), 1).squeeze(-1),
        ),
        "rollout: half the games run while the network serves the others (refused)": (
            rollout_step(threads),
            rollout_step(threads, groups=2),
        ),
        "rollout: twice as many threads for the games (refused)": (rollout_step(threads), rollout_step(2 * threads)),
        "rollout: the games' threads bound to a core each (refused)": (
            rollout_step(threads),
            rollout_step(threads, thread_affinity_offset=0),
        ),
    }


def main() -> None:
    args = parse(Args, description=__doc__)
    torch.set_num_threads(args.threads)
    setting = f"{kind_of_processor()}, {args.threads} threads, {args.rounds} rounds"
    tell(f"torch {torch.__version__}, {setting}\n")
    tell("| trick | plain, ms | trick, ms | plain / trick (quartiles) |\n|-|-|-|-|")
    for name, pair in tricks(args.threads).items():
        measured = []
        for _ in range(args.rounds + 1):
            measured.append([time_of(form, args.seconds) for form in pair])
        plain, trick = zip(*measured[1:])  # the first round warms up
        ratios = [a / b for a, b in zip(plain, trick)]
        low, _, high = quantiles(ratios, n=4)
        times = f"{1e3 * median(plain):.3g} | {1e3 * median(trick):.3g}"
        tell(f"| {name} | {times} | {median(ratios):.2f} ({low:.2f} to {high:.2f}) |")


def time_of(form: Callable, seconds: float) -> float:
    """Returns the seconds that one call of `form` takes, averaged over at least `seconds`."""
    calls, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        form()
        calls += 1
    return (time.perf_counter() - start) / calls


if __name__ == "__main__":
    main()
