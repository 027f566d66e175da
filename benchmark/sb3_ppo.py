"""Stable-Baselines3's PPO with the thesis's hyperparameters (appendix A): a peer for `throughput.py --peer`.

    pip install -e '.[peer]'
    python benchmark/sb3_ppo.py --env-id BreakoutNoFrameskip-v4 --total-timesteps 10240

It logs one curve, `charts/SPS`, at the end of each iteration, as the scripts do. Its value loss is not clipped and has
no factor ½, which costs no time; its Atari runs in Python wrappers. γ, λ, c₁ and the gradient's norm are its defaults.
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
    """agent steps over all environments"""
    num_envs: int = 8
    """environments played at once"""


class TimedPPO(PPO):
    """PPO that logs its speed once the update is done: the library's own logs are written before it."""

    def train(self) -> None:
        super().train()
        seconds = time.perf_counter() - self.started
        self.writer.add_scalar("charts/SPS", self.num_timesteps / seconds, self.num_timesteps)


def main() -> None:
    args = tyro.cli(Args, description=__doc__)
    gym.register_envs(ale_py)
    envs = VecFrameStack(make_atari_env(args.env_id, n_envs=args.num_envs, seed=1), n_stack=4)
    agent = TimedPPO(
        "CnnPolicy",
        envs,
        n_steps=128,
        batch_size=128 * args.num_envs // 4,  # 4 minibatches at any number of environments, as in the scripts
        n_epochs=4,
        learning_rate=lambda remaining: remaining * 2.5e-4,
        clip_range=0.1,
        ent_coef=0.01,
        seed=1,
        device="cpu",
    )
    agent.writer = SummaryWriter("runs")
    agent.started = time.perf_counter()
    agent.learn(args.total_timesteps)
    agent.writer.close()


if __name__ == "__main__":
    main()
