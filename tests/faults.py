"""Single faults such as this code could have, each made in a copy of the project: which test notices it first?

    python tests/faults.py                           # all of them, a row of a Markdown table each
    python tests/faults.py --only 'clip|learning'    # those whose words match
    python tests/faults.py --fast -n 2               # the plain suite alone; unknown flags go to pytest

The tests that a fault names are tried first, then the whole plain suite, then the slow tests. That the two scripts
are siblings would give away every fault in one of them, so it is made in both, and tests/test_siblings.py does not
count unless a fault names it.
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

# Fault | file | the tests to be tried first; then the text that goes and the text that comes, as in a diff
FAULTS = r"""
a termination does not cut the bootstrap | both scripts | test_mathematics.py
-gamma * next_values * ~terminations - values
+gamma * next_values - values

a truncation cuts the bootstrap as a termination does | both scripts | test_mathematics.py
-gamma * next_values * ~terminations - values
+gamma * next_values * ~(terminations | truncations) - values

advantages flow back across a truncation into the episode before | both scripts | test_mathematics.py
-not_done = ~(terminations | truncations)
+not_done = ~terminations

γ² where γλ belongs | both scripts | test_mathematics.py
-gamma * gae_lambda * not_done[t]
+gamma * gamma * not_done[t]

a truncation bootstraps from the first observation of the next episode | both scripts | test_training.py -k bootstraps
-next_values = torch.where(truncations, final_values, values[1:])
+next_values = values[1:]

the value of a final observation is kept for the step before | both scripts | test_training.py -k bootstraps
-final_values[t, truncations[t]]
+final_values[t - 1, truncations[t]]

the clip range takes a signed advantage | acppo_atari.py | test_mathematics.py
-advantages.detach().abs()
+advantages.detach()

the clip range has a gradient | acppo_atari.py | test_mathematics.py
-advantages.detach().abs()
+advantages.abs()

c counts twice in the clip range | acppo_atari.py | test_mathematics.py
-(1 + c * size)
+(1 + c * c * size)

at c = inf the clip range grows with the advantage | acppo_atari.py | test_mathematics.py
-clip_coef / size if math.isinf(c)
+clip_coef * size if math.isinf(c)

the larger of the clipped and the plain objective | both scripts | test_mathematics.py
-torch.min(ratio * advantages,
+torch.max(ratio * advantages,

a ratio is clipped above alone | both scripts | test_mathematics.py
-ratio.clamp(1 - clip, 1 + clip)
+torch.minimum(ratio, 1 + clip)

the smaller of the clipped and the plain value loss | both scripts | test_mathematics.py
-squared_error = torch.max(
+squared_error = torch.min(

advantages are normalised over the rollout, not the minibatch | both scripts | test_training.py -k within_each
-mb_advantages = normalize(mb_advantages)
+mb_advantages = normalize(b_advantages)[mb_inds]

the loss rewards a policy without entropy | both scripts | test_fast_form.py
-- args.ent_coef * entropy
++ args.ent_coef * entropy

the value loss is not weighted | both scripts | test_fast_form.py
-args.vf_coef * v_loss
+v_loss

the gradient is clipped before it is computed | both scripts | test_training.py -k norm_is_clipped
-                loss.backward()
-                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
+                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
+                loss.backward()

gradients add up over minibatches | both scripts | test_training.py -k own_minibatch
-optimizer.zero_grad()
+pass

every epoch has the same minibatches | both scripts | test_training.py -k order_of_its_own
-torch.randperm(args.batch_size, device=device)
+torch.randperm(args.batch_size, generator=torch.Generator().manual_seed(iteration)).to(device)

ratios are taken to the policy that is being updated | both scripts | test_fast_form.py
-(new_logprobs - b_logprobs[mb_inds])
+(new_logprobs - new_logprobs.detach())

--target-kl is ignored | both scripts | test_training.py -k target_kl
-if epoch_kl > args.target_kl:
+if epoch_kl > math.inf:

--target-kl is held against the last minibatch | both scripts | test_training.py -k mean_over_an_epoch
-minibatch_stats[-args.num_minibatches :]
+minibatch_stats[-1:]

the learning rate is one iteration ahead | both scripts | test_training.py -k learning_rate
-(1 - (iteration - 1) / args.num_iterations)
+(1 - iteration / args.num_iterations)

Adam has torch's own eps | both scripts | test_training.py -k own_minibatch
-eps=1e-5, fused
+eps=1e-8, fused

each rollout begins with the run's first observation | both scripts | test_training.py -k observation_before
-obs[0] = obs[T]
+obs[0] = first_obs

a new policy is far from uniform | both scripts | test_training.py -k nearly_uniform
-nn.Linear(512, num_actions), gain=0.01)
+nn.Linear(512, num_actions), gain=1.0)

hidden layers begin with gain 1 | both scripts | test_training.py -k nearly_uniform
-gain: float = math.sqrt(2)
+gain: float = 1.0

the KL is that of the last minibatch | both scripts | test_training.py -k every_logged
-policy_change(b_logprobs, new_logprobs, b_actions, rollout_advantages)
+policy_change(*(x[mb_inds] for x in (b_logprobs, new_logprobs, b_actions, rollout_advantages)))

of an iteration's minibatches the largest loss is logged | both scripts | test_training.py -k every_logged
-torch.stack(minibatch_stats).mean(0)
+torch.stack(minibatch_stats).amax(0)

the clip fraction holds every sample against ε | acppo_atari.py | test_training.py -k every_logged
-((ratio - 1).abs() > clip)
+((ratio - 1).abs() > args.clip_coef)

the explained variance is divided by that of the values | both scripts | test_training.py -k every_logged
-variance = b_returns.var()
+variance = b_values.var()

environments get the seeds seed, seed + 1, … | wrappers.py | test_wrappers.py
-return [int(number) for number in numbers[-num_envs:]]
+return [int(np.sum(seed)) + starts * num_envs + n for n in range(num_envs)]

a resumed run plays its first games again | both scripts | test_resume.py -k has_not_played
-env_seeds(args.seed, N, run.num_starts)
+env_seeds(args.seed, N, 0)

Adam's moments are not taken from the checkpoint | bookkeeping.py | test_resume.py -k moments_and
-optimizer.load_state_dict({**optimizer.state_dict(), "state": state["optimizer"]})
+pass

the random state is not taken from the checkpoint | bookkeeping.py | test_resume.py -k moments_and
-torch.set_rng_state(state["rng"][0])
+pass

a run's directory is not locked | bookkeeping.py | test_resume.py -k two_processes
-self.lock.acquire(blocking=False)
+pass

event files keep what was logged after the checkpoint | bookkeeping.py | test_playing.py -k rid_of
-os.truncate(os.path.join(self.path, name), min(size, state["event_files"].get(name, 0)))
+pass

event files are named by the clock alone | bookkeeping.py | test_resume.py -k sorts_after
-second = max(int(time.time()), *(int(match[1]) + 1 for match in before if match), 0)
+second = int(time.time())

half of what cannot be appended stays | bookkeeping.py | test_resume.py -k appended
-os.truncate(path, size) if size else os.remove(path)
+pass

screens are divided by 256 | both scripts | test_fast_form.py
-.div_(255.0)
+.div_(256.0)

a checkpoint is written over the last one | bookkeeping.py | test_resume.py -k breaks_off
-new = self.checkpoint + ".new"
+new = self.checkpoint

a number that is not finite is saved | both scripts | test_resume.py -k finite
-if broken:
+if False:

FIRE is pressed at the start of a game alone | wrappers.py | test_wrappers.py
-self.life_starts = game_over | life_lost
+self.life_starts = game_over

a lost life ends the game whose score is logged | wrappers.py | test_wrappers.py
-    envs = RecordEpisodeStatistics(envs)  # above EpisodicLife it would count lives, above the sign clipped rewards
-    envs = EpisodicLife(envs)
+    envs = EpisodicLife(envs)
+    envs = RecordEpisodeStatistics(envs)

the last life counts as lost before the game is over | wrappers.py | test_wrappers.py -k frame_by_frame
- & (infos["lives"] > 0)

an evaluation plays the likeliest actions | both scripts | test_playing.py -k draws_its_actions
-torch.multinomial(logprobs.exp(), 1, generator=generator).squeeze(-1), logprobs
+(logprobs.argmax(-1) if generator else torch.multinomial(logprobs.exp(), 1).squeeze(-1)), logprobs

an evaluation draws from the training's random numbers | both scripts | test_playing.py -k 'games or share'
-act(agent, from_envs(obs, device), generator)
+act(agent, from_envs(obs, device))

an evaluation plays the games that the training began with | bookkeeping.py | test_playing.py -k other_games_than
-[args.seed, 1], stop)
+[args.seed], stop)

a run is finished only at a step that no whole rollout reaches | benchmark/atari5.py | test_atari5.py -k whole_rollout
-min(args.total_timesteps // rollout * rollout,
+min(args.total_timesteps,

the grid goes on with the older of two directories | benchmark/atari5.py | test_atari5.py -k the_newer
-return max((args.out / "runs").glob(
+return min((args.out / "runs").glob(

the grid goes on with a run of other arguments | benchmark/atari5.py | test_atari5.py -k another_run
-if name not in ignored and trained.get(name) != wanted.get(name)
+if name not in ignored and trained.get(name, wanted.get(name)) is None

runs of two seeds make a pair | benchmark/claims.py | test_figures.py -k pair_has
-[(base[seed], new[seed]) for seed in sorted(base.keys() & new.keys())]
+list(zip(base.values(), new.values()))

one script alone is changed | ppo_atari.py | test_siblings.py
-if epoch_kl > args.target_kl:
+if epoch_kl > 1.5 * args.target_kl:
"""


class Fault(NamedTuple):
    what: str
    files: list[str]
    tests: list[str]
    old: str  # stands in each of the files, once
    new: str


def read_faults() -> list[Fault]:
    faults = []
    for block in FAULTS.strip().split("\n\n"):
        head, *lines = block.splitlines()
        what, where, tests = head.split(" | ")
        files = ["ppo_atari.py", "acppo_atari.py"] if where == "both scripts" else [where]
        old, new = ("\n".join(line[1:] for line in lines if line[0] == sign) for sign in "-+")
        faults.append(Fault(what, files, shlex.split("tests/" + tests), old, new))
    return faults


def copy_with(fault: Fault, directory: Path) -> None:
    """Copies the tracked files, as they are in the working tree, and makes the fault in the copy."""
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for name in filter(None, names.split("\0")):
        (directory / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, directory / name)
    for name in fault.files:
        text = (directory / name).read_text(encoding="utf-8")
        assert text.count(fault.old) == 1, f"{name} has this {text.count(fault.old)} times: {fault.old}"
        (directory / name).write_text(text.replace(fault.old, fault.new), encoding="utf-8")


def first_failure(directory: str, *arguments: str) -> str | None:
    """Returns the id of the first test that fails, None if none does."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "--tb=no",
        "-rfE",
        "-p",
        "no:cacheprovider",
        "-n0",
        *arguments,
    ]
    run = subprocess.run(command, cwd=directory, capture_output=True, text=True)
    if failed := re.search(r"^(?:FAILED|ERROR) (?:tests/)?(.*?)(?: - .*)?$", run.stdout, re.MULTILINE):
        return failed[1]
    assert run.returncode in (0, 5), run.stdout + run.stderr  # 5: there is no test of that name
    return None


def row(fault: Fault, fast: bool, given: list[str]) -> str:
    siblings = "tests/test_siblings.py"
    given = given if siblings in fault.tests else [*given, f"--ignore={siblings}"]
    stages = [fault.tests, ["tests"], *([] if fast else [["tests", "-m", "slow"]])]
    with tempfile.TemporaryDirectory() as directory:
        copy_with(fault, Path(directory))
        failures = (first_failure(directory, *stage, *given) for stage in stages)
        failure = next(filter(None, failures), None)
    return f"| {fault.what} | {f'`{failure}`' if failure else 'survived'} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", metavar="REGEX", help="faults whose words it is found in")
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="faults at once")
    parser.add_argument("--fast", action="store_true", help="leave out the slow tests")
    args, given = parser.parse_known_args()
    faults = [fault for fault in read_faults() if re.search(args.only, fault.what)]
    print("| fault | first test that fails |\n|-|-|", flush=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        for line in pool.map(lambda fault: row(fault, args.fast, given), faults):
            print(line, flush=True)


if __name__ == "__main__":
    main()
