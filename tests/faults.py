"""Single faults such as this code could have, each made in a copy of the project: which test notices it?

    python tests/faults.py                           # all of them, a row of a Markdown table each
    python tests/faults.py --only 'clip|learning'    # those whose words match, in two processes of pytest at once
    python tests/faults.py --fast -n 2               # the plain suite alone; what follows goes to pytest

The tests that a fault names are tried first, then the whole plain suite, then the slow tests. That the two scripts
are siblings would give away almost every fault in one of them, so it is made in both, and tests/test_siblings.py does
not count but where a fault names it.
"""

import argparse
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parent.parent
BOTH = ("ppo_atari.py", "acppo_atari.py")
ACPPO, WRAPPERS, BOOKKEEPING = ("acppo_atari.py",), ("wrappers.py",), ("bookkeeping.py",)
GRID, CLAIMS = ("benchmark/atari5.py",), ("benchmark/claims.py",)
MATHEMATICS, TRAINING, RESUME = "tests/test_mathematics.py", "tests/test_training.py", "tests/test_resume.py"
GAMES, PLAYING = "tests/test_wrappers.py", "tests/test_playing.py"


class Fault(NamedTuple):
    what: str
    files: tuple[str, ...]
    old: str  # stands in each of the files, once
    new: str
    tests: str  # that are likeliest to notice it, as given to pytest


FAULTS = [
    # Advantages
    Fault(
        "a termination does not cut the bootstrap",
        BOTH,
        "gamma * next_values * ~terminations - values",
        "gamma * next_values - values",
        MATHEMATICS,
    ),
    Fault(
        "a truncation cuts the bootstrap as a termination does",
        BOTH,
        "gamma * next_values * ~terminations - values",
        "gamma * next_values * ~(terminations | truncations) - values",
        MATHEMATICS,
    ),
    Fault(
        "advantages flow back across a truncation into the episode before",
        BOTH,
        "not_done = ~(terminations | truncations)",
        "not_done = ~terminations",
        MATHEMATICS,
    ),
    Fault("γ² where γλ belongs", BOTH, "gamma * gae_lambda * not_done[t]", "gamma * gamma * not_done[t]", MATHEMATICS),
    Fault(
        "a truncation bootstraps from the first observation of the next episode",
        BOTH,
        "next_values = torch.where(truncations, final_values, values[1:])",
        "next_values = values[1:]",
        f"{TRAINING} -k bootstraps",
    ),
    Fault(
        "the value of a final observation is kept for the step before",
        BOTH,
        "final_values[t, truncations[t]]",
        "final_values[t - 1, truncations[t]]",
        f"{TRAINING} -k bootstraps",
    ),
    # Clip range, surrogate, value loss
    Fault(
        "the clip range takes a signed advantage",
        ACPPO,
        "advantages.detach().abs()",
        "advantages.detach()",
        MATHEMATICS,
    ),
    Fault("the clip range has a gradient", ACPPO, "advantages.detach().abs()", "advantages.abs()", MATHEMATICS),
    Fault("c counts twice in the clip range", ACPPO, "(1 + c * size)", "(1 + c * c * size)", MATHEMATICS),
    Fault(
        "at c = inf the clip range grows with the advantage",
        ACPPO,
        "clip_coef / size if math.isinf(c)",
        "clip_coef * size if math.isinf(c)",
        MATHEMATICS,
    ),
    Fault(
        "the larger of the clipped and the plain objective",
        BOTH,
        "torch.min(ratio * advantages,",
        "torch.max(ratio * advantages,",
        MATHEMATICS,
    ),
    Fault(
        "a ratio is clipped above alone",
        BOTH,
        "ratio.clamp(1 - clip, 1 + clip)",
        "torch.minimum(ratio, 1 + clip)",
        MATHEMATICS,
    ),
    Fault(
        "the smaller of the clipped and the plain value loss",
        BOTH,
        "squared_error = torch.max(",
        "squared_error = torch.min(",
        MATHEMATICS,
    ),
    # Update
    Fault(
        "advantages are normalised over the rollout, not the minibatch",
        BOTH,
        "mb_advantages = normalize(mb_advantages)",
        "mb_advantages = normalize(b_advantages)[mb_inds]",
        f"{TRAINING} -k within_each",
    ),
    Fault(
        "the loss rewards a policy without entropy",
        BOTH,
        "- args.ent_coef * entropy",
        "+ args.ent_coef * entropy",
        "tests/test_fast_form.py",
    ),
    Fault("the value loss is not weighted", BOTH, "args.vf_coef * v_loss", "v_loss", "tests/test_fast_form.py"),
    Fault(
        "the gradient is clipped before it is computed",
        BOTH,
        """\
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
""",
        """\
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                loss.backward()
""",
        f"{TRAINING} -k norm_is_clipped",
    ),
    Fault(
        "gradients add up over minibatches",
        BOTH,
        "                optimizer.zero_grad()\n",
        "",
        f"{TRAINING} -k own_minibatch",
    ),
    Fault(
        "every epoch has the same minibatches",
        BOTH,
        "torch.randperm(args.batch_size, device=device)",
        "torch.randperm(args.batch_size, generator=torch.Generator().manual_seed(iteration)).to(device)",
        f"{TRAINING} -k order_of_its_own",
    ),
    Fault(
        "ratios are taken to the policy that is being updated",
        BOTH,
        "(new_logprobs - b_logprobs[mb_inds])",
        "(new_logprobs - new_logprobs.detach())",
        "tests/test_fast_form.py",
    ),
    Fault(
        "--target-kl is ignored",
        BOTH,
        "if epoch_kl > args.target_kl:",
        "if epoch_kl > math.inf:",
        f"{TRAINING} -k target_kl",
    ),
    Fault(
        "the learning rate is one iteration ahead",
        BOTH,
        "(1 - (iteration - 1) / args.num_iterations)",
        "(1 - iteration / args.num_iterations)",
        f"{TRAINING} -k learning_rate",
    ),
    Fault("Adam has torch's own eps", BOTH, "eps=1e-5, fused", "eps=1e-8, fused", f"{TRAINING} -k own_minibatch"),
    # Rollout
    Fault(
        "each rollout begins with the run's first observation",
        BOTH,
        "obs[0] = obs[T]",
        "obs[0] = first_obs",
        f"{TRAINING} -k observation_before",
    ),
    # Log
    Fault(
        "the KL is that of the last minibatch",
        BOTH,
        "policy_change(b_logprobs, new_logprobs, b_actions, rollout_advantages)",
        "policy_change(*(x[mb_inds] for x in (b_logprobs, new_logprobs, b_actions, rollout_advantages)))",
        f"{TRAINING} -k every_logged",
    ),
    Fault(
        "of an iteration's minibatches the largest loss is logged",
        BOTH,
        "torch.stack(minibatch_stats).mean(0)",
        "torch.stack(minibatch_stats).amax(0)",
        f"{TRAINING} -k every_logged",
    ),
    Fault(
        "the clip fraction holds every sample against ε",
        ACPPO,
        "((ratio - 1).abs() > clip)",
        "((ratio - 1).abs() > args.clip_coef)",
        f"{TRAINING} -k every_logged",
    ),
    Fault(
        "the explained variance is divided by that of the values",
        BOTH,
        "variance = b_returns.var()",
        "variance = b_values.var()",
        f"{TRAINING} -k every_logged",
    ),
    # Seeds, checkpoints, stopping
    Fault(
        "environments get the seeds seed, seed + 1, …",
        WRAPPERS,
        "return [int(number) for number in numbers[-num_envs:]]",
        "return [int(np.sum(seed)) + starts * num_envs + n for n in range(num_envs)]",
        GAMES,
    ),
    Fault(
        "a resumed run plays its first games again",
        BOTH,
        "env_seeds(args.seed, N, run.num_starts)",
        "env_seeds(args.seed, N, 0)",
        f"{RESUME} -k other_games",
    ),
    Fault(
        "Adam's moments are not taken from the checkpoint",
        BOOKKEEPING,
        """optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})""",
        "pass",
        f"{RESUME} -k moments_and",
    ),
    Fault(
        "the random state is not taken from the checkpoint",
        BOOKKEEPING,
        """torch.set_rng_state(state["rng"][0])""",
        "pass",
        f"{RESUME} -k moments_and",
    ),
    Fault(
        "a run's directory is not locked",
        BOOKKEEPING,
        "fcntl.flock(self.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)",
        "pass",
        f"{RESUME} -k two_processes",
    ),
    Fault(
        "event files keep what was logged after the checkpoint",
        BOOKKEEPING,
        """os.truncate(os.path.join(self.path, name), min(size, state["event_files"].get(name, 0)))""",
        "pass",
        f"{PLAYING} -k rid_of",
    ),
    Fault(
        "a checkpoint is written over the last one",
        BOOKKEEPING,
        """new = self.checkpoint + ".new\"""",
        "new = self.checkpoint",
        f"{RESUME} -k breaks_off",
    ),
    Fault(
        "a number that is not finite is saved", BOTH, "        if broken:", "        if False:", f"{RESUME} -k finite"
    ),
    # Environments
    Fault(
        "FIRE is pressed at the start of a game alone",
        WRAPPERS,
        "self.life_starts = game_over | life_lost",
        "self.life_starts = game_over",
        GAMES,
    ),
    Fault(
        "a lost life ends the game whose score is logged",
        WRAPPERS,
        """\
    envs = RecordEpisodeStatistics(envs)  # above EpisodicLife it would count lives, above the sign clipped rewards
    envs = EpisodicLife(envs)
""",
        """\
    envs = EpisodicLife(envs)
    envs = RecordEpisodeStatistics(envs)
""",
        GAMES,
    ),
    Fault(
        "the last life counts as lost before the game is over",
        WRAPPERS,
        """ & (infos["lives"] > 0)""",
        "",
        f"{GAMES} -k frame_by_frame",
    ),
    Fault(
        "an evaluation plays the likeliest actions",
        BOTH,
        "torch.multinomial(logprobs.exp(), 1, generator=generator).squeeze(-1), logprobs",
        "(logprobs.argmax(-1) if generator else torch.multinomial(logprobs.exp(), 1).squeeze(-1)), logprobs",
        f"{PLAYING} -k draws_its_actions",
    ),
    Fault(
        "an evaluation draws from the training's random numbers",
        BOTH,
        "act(agent, from_envs(obs, device), generator)",
        "act(agent, from_envs(obs, device))",
        f"{PLAYING} -k 'games or share'",
    ),
    # Grid, figures, siblings
    Fault(
        "a run is finished only at a step that no whole rollout reaches",
        GRID,
        "min(args.total_timesteps // rollout * rollout,",
        "min(args.total_timesteps,",
        "tests/test_atari5.py -k whole_rollout",
    ),
    Fault(
        "the grid goes on with a run of other arguments",
        GRID,
        "if (has := trained.get(name)) != value:",
        "if (has := trained.get(name, value)) is None:",
        "tests/test_atari5.py -k another_run",
    ),
    Fault(
        "runs of two seeds make a pair",
        CLAIMS,
        "[(ppos[seed], acppos[seed]) for seed in sorted(ppos.keys() & acppos.keys())]",
        "list(zip(ppos.values(), acppos.values()))",
        "tests/test_figures.py -k pair_has",
    ),
    Fault(
        "one script alone is changed",
        ("ppo_atari.py",),
        "if epoch_kl > args.target_kl:",
        "if epoch_kl > 1.5 * args.target_kl:",
        "tests/test_siblings.py",
    ),
]


def copy_with(fault: Fault, directory: Path) -> None:
    """Copies what git tracks, as it is in the working tree, and makes the fault in it."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, directory / name)
    for name in fault.files:
        text = (directory / name).read_text(encoding="utf-8")
        assert text.count(fault.old) == 1, f"{name} has {text.count(fault.old)} times: {fault.old}"
        (directory / name).write_text(text.replace(fault.old, fault.new), encoding="utf-8")


def first_failure(directory: Path, *arguments: str) -> str | None:
    """Returns the id of the first test that fails, None where none does."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "--tb=no", "-rfE", "-p", "no:cacheprovider", *arguments]
    run = subprocess.run(command, cwd=directory, capture_output=True, text=True)
    if failed := re.search(r"^(?:FAILED|ERROR) (?:tests/)?(.*?)(?: - .*)?$", run.stdout, re.MULTILINE):
        return failed[1]
    assert run.returncode in (0, 5), run.stdout + run.stderr  # 5: no test of that name
    return None


def row(fault: Fault, fast: bool, given: list[str]) -> str:
    given = [*given, *([] if "siblings" in fault.tests else ["--ignore=tests/test_siblings.py"])]
    with tempfile.TemporaryDirectory() as directory:
        copy_with(fault, Path(directory))
        stages = [shlex.split(fault.tests), ["tests"], *([] if fast else [["tests", "-m", "slow"]])]
        failures = (first_failure(Path(directory), *stage, *given) for stage in stages)
        noticed = next(filter(None, failures), None)
    return f"| {fault.what} | {f'`{noticed}`' if noticed else 'survived'} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="REGEX", help="faults whose words it is found in")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="faults at once")
    parser.add_argument("--fast", action="store_true", help="leave out the slow tests")
    args, given = parser.parse_known_args()
    faults = [fault for fault in FAULTS if re.search(args.only, fault.what)]
    print("| fault | first test that fails |\n|-|-|", flush=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        for line in pool.map(lambda fault: row(fault, args.fast, given), faults):
            print(line, flush=True)


if __name__ == "__main__":
    main()
