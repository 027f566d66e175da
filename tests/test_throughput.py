"""The speed measurements: how the numbers are read, their tables, and one call as a user makes it."""

import ast
import subprocess
import sys

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.tensorboard import SummaryWriter

import acppo_atari
import bookkeeping
from benchmark import limits, throughput
from benchmark.readme import split_readme
from benchmark.throughput import Contender, Row
from conftest import ROOT


def row(name: str, *rounds: list[float], peer: bool = False) -> Row:
    """A row whose jobs ran at the given steps/s, round by round."""
    runs = [
        [{"steps_per_second": speed, "peak_mb": 500, "time/first_iteration": 5} for speed in jobs] for jobs in rounds
    ]
    return Row(Contender(name, (), "commit", "2.13.0", peer), num_envs=8, threads=2, jobs=len(rounds[0]), rounds=runs)


def log_iterations(directory, ends: list[float], phases: dict[str, list[float]]) -> list[throughput.Iteration]:
    """Writes an event file with iterations of 1000 agent steps that end at the given times, and reads it."""
    writer = SummaryWriter(str(directory / "a-run"))
    for i, end in enumerate(ends):
        writer.add_scalar("charts/SPS", 0.0, 1000 * (i + 1), walltime=end)
        for phase, seconds in phases.items():
            writer.add_scalar(f"time/{phase}", seconds[i], 1000 * (i + 1), walltime=end)
    writer.close()
    return throughput.read_iterations(directory)


def cells(markdown: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in markdown.splitlines()]


def test_ratios_are_taken_round_by_round_before_their_median():
    fast, slow = row("fast", [100], [300], [400]), row("slow", [50], [100], [400])
    assert throughput.ratios(fast, slow) == [2, 3, 1]
    assert throughput.spread(throughput.ratios(fast, slow), 2) == "2.00 (1.00 to 3.00)"  # of the medians: 3
    assert throughput.spread(fast.speeds) == "300 (100 to 400)"


def test_jobs_add_up_within_a_round():
    assert row("two at once", [500, 600], [550, 650]).speeds == [1100, 1200]


def test_every_row_is_compared_with_the_first_and_with_the_peer_at_its_own_setting():
    rows = [row("script", [800]), row("peer", [400], peer=True), row("script", [500, 500]), row("peer", [200, 200])]
    rows[3].contender = rows[1].contender
    header, _, *table = cells(throughput.speed_table(rows))
    columns = [header.index(name) for name in ("contender", "jobs", "× first row", "× peer")]
    assert [[line[column].split(" (")[0] for column in columns] for line in table] == [
        ["script", "1", "–", "2.00"],
        ["peer", "1", "0.50", "–"],
        ["script", "2", "1.25", "2.50"],
        ["peer", "2", "0.50", "–"],
    ]


def test_speed_and_phases_are_read_from_the_window_alone(tmp_path):
    phases = {"environment": [9, 9, 0.5, 0.25, 1.0], "update": [9, 9, 1.0, 1.5, 2.0], "any other": [9, 9, 0, 0, 0]}
    iterations = log_iterations(tmp_path, [1000, 1020, 1022, 1024, 1028], phases)
    run = throughput.measure(iterations, start=1020, end=1028)  # iterations of 2, 2 and 4 seconds
    assert run == {
        "steps_per_second": 3000 / 8,
        "time/iteration": 2,
        "time/environment": 0.5,
        "time/update": 1.5,
        "time/any other": 0,
        "time/unaccounted": 0.5,  # of 0.5, 0.25 and 1
    }


def test_the_split_shows_each_phase_and_what_no_phase_counts(tmp_path):
    phases = {"environment": [1, 1, 1], "update": [2, 2, 2], "rest": [0.25, 0.25, 0.25]}
    run = throughput.measure(log_iterations(tmp_path, [1000, 1004, 1008], phases), start=1000, end=1008)
    header, _, line = cells(throughput.phase_table([Row(Contender("script", (), "", ""), 8, 2, 1, [[run]])]))
    shown = dict(zip(header, line))
    assert header[4:] == ["iteration, ms", "environment", "update", "rest", "unaccounted"]
    assert shown["iteration, ms"] == "4000"
    assert shown["environment"] == "1000 (25.0%)"
    assert shown["rest"] == "250 (6.2%)"
    assert shown["unaccounted"] == "750 (18.8%)"


def test_a_peer_logs_no_phases_and_has_no_split(tmp_path):
    run = throughput.measure(log_iterations(tmp_path, [1000, 1004], {}), start=1000, end=1004)
    assert run == {"steps_per_second": 250, "time/iteration": 4}
    assert len(cells(throughput.phase_table([Row(Contender("peer", (), "", "", True), 8, 2, 1, [[run]])]))) == 2


def test_limits_are_shared_out_as_agent_steps():
    gflops = (limits.AGENT_STEP + limits.KL_PASS) / 1000  # of one agent step
    measured = {(8, 2): dict(zip(limits.LIMITS, (1600 * gflops, 3200 * gflops, 4800)))}
    shown = cells(throughput.limits_table([row("script", [800])], measured))[2]
    assert shown[4:] == ["50% of 1,600", "25% of 3,200", "17% of 4,800", "67% of 1,200", "42% of 1,920"]


def test_the_work_counted_for_an_agent_step_is_the_networks():
    agent = acppo_atari.Agent((4, 84, 84), num_actions=4)
    heads = 2 * 512 * 5 / 1e6  # left out of the constants: they depend on the game
    with FlopCounterMode(display=False) as forward:
        logits, values = agent(torch.zeros(2, 84, 84, 4, dtype=torch.uint8))
    assert forward.get_total_flops() / 2e6 == pytest.approx(limits.FORWARD + heads)
    with FlopCounterMode(display=False) as backward:
        (logits.sum() + values.sum()).backward()
    assert backward.get_total_flops() / 2e6 == pytest.approx(limits.BACKWARD + 2 * heads)


def test_the_probes_give_a_speed():
    assert limits.probe_convolutions(torch.get_num_threads(), "float32", seconds=0.0) > 0
    assert limits.probe_emulator("breakout", 2, 1, seconds=0.01) > 0


def test_a_call_prints_a_row_for_each_contender_and_adds_one_for_each_process(tmp_path, monkeypatch, capfd):
    results = tmp_path / "made" / "throughput.csv"
    flags = ["acppo_atari.py --c 0", "--env-id", "CartPole-v1", "--csv", str(results)]
    flags += "--rounds 1 --warmup 1 --window 2 --num-envs 2 --threads 1".split()
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", ["throughput.py", *flags])
    throughput.main()
    tables = [cells(block) for block in capfd.readouterr().out.split("\n\n") if block.startswith("|")]
    assert [len(table) for table in tables] == [3, 3]  # speed and split; no limits outside Atari
    for table in tables:
        assert table[2][:4] == ["acppo_atari.py --c 0", "2", "1", "1"]
    _, (line,) = throughput.read_csv(results)
    assert line["contender"] == "acppo_atari.py --c 0"
    assert tables[0][2][4].startswith(f"{float(line['steps_per_second']):,.0f} (")
    # The median of two iterations is their mean
    assert float(line["steps_per_second"]) == pytest.approx(2 * 128 / float(line["time/iteration"]), rel=1e-4)
    assert 50 < float(line["peak_mb"]) < 5000  # an interpreter with torch, and no more
    work = ("inference", "environment", "update", "kl_pass", "first_iteration")
    assert all(float(line[f"time/{name}"]) > 0 for name in work)
    assert line["torch"].startswith("2.13.0") and line["cpu"] and line["commit"] and line["date"]
    assert line["kind"] == bookkeeping.kind_of_processor()


@pytest.mark.parametrize("program", sorted((ROOT / "benchmark").glob("*.py")), ids=lambda path: path.stem)
def test_no_program_prints_what_may_have_no_reader(program):
    """`print` ends it in a traceback or status 120 after `| true`, or on a full disk; `tell` does not."""
    nodes = ast.walk(ast.parse(program.read_bytes()))
    assert [node.lineno for node in nodes if isinstance(node, ast.Name) and node.id == "print"] == []


def test_rows_with_other_phases_are_added_and_those_that_are_there_stay(tmp_path):
    path = tmp_path / "throughput.csv"
    throughput.add_rows(path, [{"contender": "a", "steps_per_second": "1", "time/storage": "0.5"}])
    throughput.add_rows(path, [{"contender": "b, c", "steps_per_second": "2", "time/rest": "0.25"}])
    header, rows = throughput.read_csv(path)
    assert header == [*throughput.CSV_FIELDS, "time/storage", "time/rest"]
    kept = [[line[name] for name in ("contender", "steps_per_second", "time/storage", "time/rest")] for line in rows]
    assert kept == [["a", "1", "0.5", ""], ["b, c", "2", "", "0.25"]]


def test_the_rows_of_a_call_are_marked_as_such(tmp_path, monkeypatch):
    """So that a second call into the same file is no further round of the first one."""
    measured = {"steps_per_second": 1.0, "peak_mb": 1.0, "time/first_iteration": 1.0, "time/iteration": 1.0}
    monkeypatch.setattr(throughput, "run_jobs", lambda row, args: [{**measured, "time/unaccounted": 0.0}])
    flags = ["ppo_atari.py", "--env-id", "CartPole-v1", "--rounds", "2", "--csv", str(tmp_path / "calls.csv")]
    monkeypatch.setattr(sys, "argv", ["throughput.py", *flags])
    monkeypatch.chdir(ROOT)
    throughput.main()
    throughput.main()
    calls = [line["call"] for line in throughput.read_csv(tmp_path / "calls.csv")[1]]
    assert calls[0] == calls[1] != calls[2] == calls[3]


def test_a_contender_s_commit_is_that_of_its_own_checkout(tmp_path, monkeypatch):
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "of another repository"))  # as in a git hook

    def git(*words: str) -> str:
        settings = [f"--git-dir={tmp_path / '.git'}", *"-c user.name=a -c user.email=b -c commit.gpgsign=no".split()]
        return subprocess.run(["git", *settings, *words], check=True, capture_output=True, text=True).stdout.strip()

    for name in ("committed.py", "beside.py"):
        (tmp_path / name).touch()
    args = throughput.Args(contenders=("committed.py", "beside.py"))
    monkeypatch.chdir(tmp_path)
    git("init", "--quiet")
    git("add", "committed.py")
    git("commit", "--quiet", "--message=one")
    committed, beside = throughput.make_contenders(args)
    assert (committed.commit, beside.commit) == (git("rev-parse", "HEAD"), git("rev-parse", "HEAD") + "-dirty")


def test_the_readme_s_table_compares_within_a_round_of_a_call_alone(tmp_path):
    same = {"env_id": "Breakout", "num_envs": 8, "threads": 2, "torch": "2.13.0", "cpu": "A chip", "peak_mb": 500}
    speeds = {  # call, round, contender
        ("1", 1, "ppo_atari.py"): 300,
        ("1", 1, "CleanRL"): 100,
        ("1", 2, "ppo_atari.py"): 200,
        ("1", 2, "CleanRL"): 200,
        ("1", 1, "ppo_atari.py, changed"): 999,
        ("2", 1, "ppo_atari.py"): 150,
        ("2", 1, "ppo_atari.py --bf16"): 900,
        ("2", 1, "Stable-Baselines3 2.9.2"): 300,
    }
    rows = [
        {**same, "call": call, "round": number, "contender": contender, "steps_per_second": speed}
        for (call, number, contender), speed in speeds.items()
    ]
    throughput.add_rows(tmp_path / "throughput_new.csv", rows)
    assert cells(throughput.readme_table(tmp_path))[2:4] == [
        [
            "A chip, NEW",
            "`ppo_atari.py`",
            "250 (200 to 300); 150 (150 to 150)",
            "2.00 (1.00 to 3.00)",
            "0.50 (0.50 to 0.50)",
            "500 (500 to 500); 500 (500 to 500)",
        ],
        [
            "A chip, NEW",
            "`ppo_atari.py --bf16`",
            "900 (900 to 900)",
            "–",
            "3.00 (3.00 to 3.00)",
            "500 (500 to 500)",
        ],
    ]


def test_the_readme_s_speeds_are_those_of_the_committed_csvs():
    assert split_readme(ROOT / "README.md", "speed")[1] == throughput.readme_table(), "run throughput.py --table"


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "name a script"),
        (["no_such.py"], "no such script"),
        (["script.py --threads 1"], "--threads is set here"),
        (["script.py 'open"], "as a shell reads them"),
        (["script.py", "--jobs", "1", "0"], "--jobs 0: give a number above 0"),
        (["script.py", "--window", "0"], "--window 0: give a number above 0"),
        (["script.py", "--env-id", "CartPole-v1", "--peer"], "a game such as Breakout"),
        (["script.py", "--env-id", "ALE/Breakout-v5", "--peer"], "a game such as Breakout"),
        (["script.py", "--env-id", "Combat"], "no mode for one player"),
        (["script.py", "--cleanrl", "."], "the directory of a checkout"),
        (["script.py", "--csv", "script.py"], "it holds other columns"),
        (["script.py", "--csv", "script.py/throughput.csv"], "cannot be written"),
        (["script.py", "--csv", "c\udcff"], "give it in UTF-8"),  # a byte that is no UTF-8, as Python decodes it
        (["s\udcff.py"], "give it in UTF-8"),
    ],
)
def test_bad_input_is_refused_in_one_line_and_leaves_nothing(flags, said, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "script.py").write_text("a,script,that,is,never,started\n")
    csv_flags = [] if "--csv" in flags else ["--csv", "throughput.csv"]
    monkeypatch.setattr(sys, "argv", ["throughput.py", *flags, *csv_flags])
    with pytest.raises(SystemExit) as exit_:
        throughput.main()
    out, err = capfd.readouterr()
    assert exit_.value.code == 2 and out == "" and err.count("\n") == 1 and said in err
    assert [path.name for path in tmp_path.iterdir()] == ["script.py"]


@pytest.mark.parametrize(
    ("program", "said"),
    [
        ("sys.exit('first\\nthe reason')", "ended with status 1: the reason"),
        ("print('╭─ error ───╮\\n│ no flag x │\\n╰───────────╯', file=sys.stderr); sys.exit(2)", "status 2: no flag x"),
        ("pass", "logged 0 iterations instead of 33"),
    ],
)
def test_a_process_that_fails_ends_the_call_with_its_last_line(program, said, tmp_path, monkeypatch):
    script = tmp_path / "script.py"
    script.write_text(f"import sys\n{program}\n")
    flags = [str(script), "--env-id", "CartPole-v1", "--jobs", "2", "--csv", str(tmp_path / "throughput.csv")]
    monkeypatch.setattr(sys, "argv", ["throughput.py", *flags])
    with pytest.raises(SystemExit) as exit_:
        throughput.main()
    assert said in exit_.value.code and "\n" not in exit_.value.code  # a text as exit code is printed, with status 1
