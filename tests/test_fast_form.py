"""The tricks that make the scripts fast do not change their results."""

import pytest
import torch
from torch import nn
from torch.distributions import Categorical

from conftest import open_run
from wrappers import make_envs


class PlainAgent(nn.Module):
    """The Nature CNN in PyTorch's default layout on float inputs (B, 4, 84, 84), nothing clever."""

    def __init__(self, num_actions: int):
        super().__init__()
        layers = [
            nn.Conv2d(4, 32, 8, 4),
            nn.ReLU(),
            nn.Conv2d(32, 64, 4, 2),
            nn.ReLU(),
            nn.Conv2d(64, 64, 3),
            nn.ReLU(),
        ]
        self.network = nn.Sequential(*layers, nn.Flatten(), nn.Linear(3136, 512), nn.ReLU())
        self.actor, self.critic = nn.Linear(512, num_actions), nn.Linear(512, 1)

    def forward(self, screens: torch.Tensor):
        hidden = self.network(screens / 255.0)
        return self.actor(hidden), self.critic(hidden).flatten()


def plain_loss(agent, screens, actions, old_logprobs, advantages, returns, old_values, args) -> torch.Tensor:
    """Section 3.1's objective with the value loss and the entropy bonus, by torch's own distributions."""
    logits, new_values = agent(screens)
    policy = Categorical(logits=logits)
    ratio = (policy.log_prob(actions) - old_logprobs).exp()
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    clip = args.clip_coef / (1 + getattr(args, "c", 0.0) * advantages.abs())
    gained = torch.minimum(ratio * advantages, torch.maximum(torch.minimum(ratio, 1 + clip), 1 - clip) * advantages)
    near = torch.clip(new_values, old_values - args.vf_clip_coef, old_values + args.vf_clip_coef)
    value_loss = torch.maximum((new_values - returns) ** 2, (near - returns) ** 2).mean() / 2
    return -gained.mean() + args.vf_coef * value_loss - args.ent_coef * policy.entropy().mean()


class FirstGradient(Exception):
    """Stops a training at its first gradient, before it is clipped."""


@pytest.mark.thesis("Agent", "normalize", "clip_range", "surrogate", "value_loss")
def test_loss_and_gradient_agree_with_the_plain_form(each_script, tmp_path, monkeypatch):
    """A rollout as one minibatch, fitted by parameters that have moved a little since, so that ratios are not all 1."""
    script = each_script
    sizes = {"num_envs": 2, "num_steps": 32, "total_timesteps": 64, "num_minibatches": 1, "update_epochs": 1}
    args = script.Args(env_id="Breakout", **sizes, threads=1)
    steps, batch, losses = [], [], []
    act, compute_gae, backward = script.act, script.compute_gae, torch.Tensor.backward

    def act_and_keep(agent, obs):
        steps.append((agent, obs.clone(), *act(agent, obs)))
        return steps[-1][2:]

    def compute_gae_and_move(rewards, values, *rest):
        batch.extend([compute_gae(rewards, values, *rest), values.clone()])
        generator = torch.Generator().manual_seed(1)
        with torch.no_grad():
            for parameter in steps[0][0].parameters():
                parameter.add_(0.01 * torch.randn(parameter.shape, generator=generator))
        return batch[0]

    def backward_and_stop(loss):
        losses.append(loss.item())
        backward(loss)
        raise FirstGradient

    monkeypatch.setattr(script, "act", act_and_keep)
    monkeypatch.setattr(script, "compute_gae", compute_gae_and_move)
    monkeypatch.setattr(torch.Tensor, "backward", backward_and_stop)
    with pytest.raises(FirstGradient), open_run(script, tmp_path) as run:
        script.train(args, make_envs(args.env_id, args.num_envs), run)
    monkeypatch.undo()

    agent, (advantages, old_values) = steps[0][0], batch
    obs, actions, logprobs = (torch.cat([step[i] for step in steps]).clone() for i in (1, 2, 3))
    plain = PlainAgent(agent.actor.out_features)
    plain.load_state_dict({name: value.contiguous() for name, value in agent.state_dict().items()})
    screens, old_logprobs = obs.movedim(-1, 1).float().contiguous(), logprobs.gather(1, actions[:, None]).squeeze(1)
    flat = (x.flatten() for x in (advantages, advantages + old_values, old_values))
    loss = plain_loss(plain, screens, actions, old_logprobs, *flat, args)
    loss.backward()
    gradient, expected = (torch.cat([p.grad.flatten() for p in model.parameters()]) for model in (agent, plain))
    assert losses == [pytest.approx(loss.item(), rel=1e-4)]
    assert expected.norm() > 0.1
    assert (gradient - expected).norm() / expected.norm() < 1e-4


@pytest.mark.thesis("Agent")
def test_bfloat16_is_for_the_trunk_alone(script, monkeypatch):
    torch.manual_seed(1)
    agent = script.Agent((4, 84, 84), 6, bf16=True)
    inside = []
    agent.network[0].register_forward_hook(lambda module, given, result: inside.append(result.dtype))
    obs = torch.randint(0, 256, (2, 84, 84, 4), dtype=torch.uint8)
    logits, value = agent(obs)
    assert inside == [torch.bfloat16]
    assert logits.dtype == value.dtype == torch.float32
    assert {parameter.dtype for parameter in agent.parameters()} == {torch.float32}
    agent.bf16 = False
    assert torch.allclose(agent(obs)[1], value, atol=0.02)


@pytest.mark.thesis("Agent")
def test_a_snapshot_acts_bit_for_bit_as_the_agent_it_is_of(script):
    """Under bfloat16 it is a copy whose trunk is cast once; without, there is nothing to cast."""
    agent = script.Agent((4, 84, 84), 6, bf16=True).to(memory_format=torch.channels_last)
    snapshot = agent.snapshot()
    obs = torch.randint(0, 256, (8, 84, 84, 4), dtype=torch.uint8)
    with torch.inference_mode():
        assert all(map(torch.equal, agent(obs), snapshot(obs)))
    assert {parameter.dtype for parameter in snapshot.network.parameters()} == {torch.bfloat16}
    assert {parameter.dtype for parameter in agent.parameters()} == {torch.float32}
    exact = script.Agent((4, 84, 84), 6)
    assert exact.snapshot() is exact
