"""Stable-Baselines3's PPO with the thesis's hyperparameters (appendix A): a peer for `throughput.py --peer`.

    pip install -e '.[peer]'
    python benchmark/sb3_ppo.py --env-id BreakoutNoFrameskip-v4 --total-timesteps 10240

It logs one curve, `charts/SPS`, at the end of each iteration, so that its speed is read as the scripts' is. Two things
are Stable-Baselines3's own: the value loss is not clipped and has no factor ½, neither of which costs time, and
Atari runs in Python wrappers, one environment after the other.
"""

import time
from dataclasses import dataclass

import ale_py
import gymnasium as gym
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_atari_env
from stable_baselines3.common.vec_env import VecFrameStack
from torch.utils.tensorboard import SummaryWriter


@dataclass
class Args:
    env_id: str = "BreakoutNoFrameskip-v4"
    """an Atari id without frame skip: Stable-Baselines3's wrappers skip frames themselves"""
    total_timesteps: int = 5_000_000
    """agent steps in all, over all environments"""
    num_envs: int = 8
    """environments played at once"""
    seed: int = 1
    """seeds torch and the environments"""
    log_dir: str = "runs"
    """directory that the curve is written to"""


class TimedPPO(PPO):
    """PPO that logs its speed once the update is done: the library's own logs are written before it."""

    def train(self) -> None:
        super().train()
        seconds = time.perf_counter() - self.started
        self.writer.add_scalar("charts/SPS", self.num_timesteps / seconds, self.num_timesteps)


def main() -> None:
    args = tyro.cli(Args)
    gym.register_envs(ale_py)
    envs = VecFrameStack(make_atari_env(args.env_id, n_envs=args.num_envs, seed=args.seed), n_stack=4)
    agent = TimedPPO(
        "CnnPolicy",
        envs,
        n_steps=128,
        batch_size=128 * args.num_envs // 4,  # 256 at 8 environments; 4 minibatches at any number, as in the scripts
        n_epochs=4,
        learning_rate=lambda remaining: remaining * 2.5e-4,
        clip_range=0.1,
        ent_coef=0.01,
        vf_coef=0.5,
        gamma=0.99,
        gae_lambda=0.95,
        max_grad_norm=0.5,
        seed=args.seed,
        device="cpu",
    )
    agent.writer = SummaryWriter(args.log_dir)
    agent.started = time.perf_counter()
    agent.learn(args.total_timesteps)
    agent.writer.close()


if __name__ == "__main__":
    main()
