"""Two limits of the processor: the convolutions that it can compute and the steps that the bare emulator can make."""

import itertools
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

LIMITS = ("float32_gflops", "bfloat16_gflops", "emulator_steps_per_second")

# Work of the Nature CNN in MFLOP a sample, a multiplication and its addition counted as two
FIRST_LAYER = 2 * 20 * 20 * 32 * 256 / 1e6
FORWARD = FIRST_LAYER + 2 * (9 * 9 * 64 * 512 + 7 * 7 * 64 * 576 + 3136 * 512) / 1e6  # 18.7
# The backward pass makes two gradients at the forward pass's price, weights' and inputs'; nobody needs a screen's
BACKWARD = 2 * FORWARD - FIRST_LAYER
AGENT_STEP = FORWARD + 4 * (FORWARD + BACKWARD)  # 217: the rollout, then four epochs
KL_PASS = FORWARD  # the scripts look at the rollout once more, peers do not


def probe_convolutions(threads: int, dtype_name: str, seconds: float = 2.0) -> float:
    """Returns the best GFLOP/s of the network's three convolutions, forward and backward on 256 samples.

    Without bfloat16 instructions each takes about a second, so the time is checked after every one of them.
    """
    import torch

    torch.set_num_threads(threads)
    layers = []
    for inputs, outputs, kernel, stride, size in ((4, 32, 8, 4, 84), (32, 64, 4, 2, 20), (64, 64, 3, 1, 9)):
        layout = {"dtype": getattr(torch, dtype_name), "memory_format": torch.channels_last}
        screens = torch.rand(256, inputs, size, size).to(**layout).requires_grad_(inputs > 4)
        layers.append((torch.nn.Conv2d(inputs, outputs, kernel, stride).to(**layout), screens))
    best, stop = 0.0, time.perf_counter() + seconds
    for convolution, screens in itertools.cycle(layers):
        if (start := time.perf_counter()) > stop and best:
            return best
        output = convolution(screens)
        output.backward(output.detach())
        elapsed = time.perf_counter() - start
        flop = 2 * output.numel() * convolution.weight[0].numel() * (3 if screens.requires_grad else 2)
        best = max(best, flop / elapsed / 1e9)


def probe_emulator(rom: str, num_envs: int, threads: int, seconds: float = 2.0) -> float:
    """Returns the best steps/s of the emulator over an eighth of the time: random actions, the network's screens."""
    import numpy as np
    from ale_py.vector_env import AtariVectorEnv

    envs = AtariVectorEnv(rom, num_envs, num_threads=threads, use_fire_reset=False)
    envs.reset(seed=1)
    actions = itertools.cycle(np.random.default_rng(1).integers(envs.single_action_space.n, size=(1000, num_envs)))
    best = 0.0
    for _ in range(8):
        steps, elapsed, start = 0, 0.0, time.perf_counter()
        while elapsed < seconds / 8:
            envs.step(next(actions))
            steps += num_envs
            elapsed = time.perf_counter() - start
        best = max(best, steps / elapsed)
    return best


def in_own_process(function, *arguments):
    """Calls a function in a process of its own: thread counts hold there, and torch's memory is not this process's."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def measure_limits(
    rom: str, all_num_envs: tuple[int, ...], all_threads: tuple[int, ...]
) -> dict[tuple[int, int], dict]:
    """Returns the limits for each number of environments and of threads."""
    limits = {}
    for threads in all_threads:
        convolutions = [in_own_process(probe_convolutions, threads, dtype) for dtype in ("float32", "bfloat16")]
        for num_envs in all_num_envs:
            emulator = in_own_process(probe_emulator, rom, num_envs, threads)
            limits[num_envs, threads] = dict(zip(LIMITS, [*convolutions, emulator]))
    return limits
