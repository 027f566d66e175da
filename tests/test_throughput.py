"""The speed measurements: how the numbers are read, their tables, and one call as a user makes it."""

import pandas as pd
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode
from torch.utils.tensorboard import SummaryWriter

import acppo_atari
import bookkeeping
import ppo_atari
from benchmark import throughput
from conftest import ROOT, cells, train


def processes(name: str, *rounds: list[float], **columns) -> pd.DataFrame:
    """Returns processes of a candidate whose jobs ran at these steps/s, round by round."""
    setting = {"candidate": name, "num_envs": 8, "threads": 2, "jobs": len(rounds[0]), "peak_mb": 500}
    speeds = [(number, speed) for number, jobs in enumerate(rounds) for speed in jobs]
    columns = {**setting, "time/iteration": 4, **columns}
    return pd.DataFrame([{**columns, "round": number, "steps_per_second": speed} for number, speed in speeds])


def log_iterations(directory, ends: list[float], phases: dict[str, list[float]]) -> pd.DataFrame:
    """Writes an event file with iterations of 1000 agent steps that end at the given times, and reads it."""
    writer = SummaryWriter(str(directory / "a-run"))
    for i, end in enumerate(ends):
        writer.add_scalar("charts/SPS", 0.0, 1000 * (i + 1), walltime=end)
        for phase, seconds in phases.items():
            writer.add_scalar(f"time/{phase}", seconds[i], 1000 * (i + 1), walltime=end)
    writer.close()
    return throughput.read_log(directory)


def test_rows_are_compared_round_by_round_with_first_row_and_peer():
    rows = [processes("script", [100], [300], [400]), processes("peer", [50], [100], [400])]
    rows += [processes("script", [60, 40], [150, 150], [200, 200]), processes("peer", [25, 25], [50, 50], [200, 200])]
    header, _, *table = cells(throughput.make_tables(pd.concat(rows), peers=["peer"])[0])
    columns = [header.index(name) for name in ("candidate", "jobs", "steps/s", "× first row", "× peer")]
    assert [[line[column] for column in columns] for line in table] == [
        ["script", "1", "300 (100 to 400)", "–", "2.00 (1.00 to 3.00)"],  # not 3, the ratio of the medians
        ["peer", "1", "100 (50 to 400)", "0.50 (0.33 to 1.00)", "–"],
        ["script", "2", "300 (100 to 400)", "1.00 (1.00 to 1.00)", "2.00 (1.00 to 3.00)"],
        ["peer", "2", "100 (50 to 400)", "0.50 (0.33 to 1.00)", "–"],
    ]


def test_speed_and_phases_are_those_of_the_window(tmp_path):
    phases = {"environment": [9, 9, 0.5, 0.25, 1.0], "update": [9, 9, 1.0, 1.5, 2.0], "any other": [9, 9, 0, 0, 0]}
    log = log_iterations(tmp_path, [1000, 1020, 1022, 1024, 1028], phases)
    assert throughput.measure(log, start=1020, end=1028) == {  # iterations of 2, 2 and 4 seconds
        "steps_per_second": 3000 / 8,
        "time/iteration": 2,
        "time/environment": 0.5,
        "time/update": 1.5,
        "time/any other": 0,
    }


def test_peer_logs_no_phases_and_has_no_row_of_them(tmp_path):
    run = throughput.measure(log_iterations(tmp_path, [1000, 1004], {}), start=1000, end=1004)
    assert run == {"steps_per_second": 250, "time/iteration": 4}
    rows = [processes("script", [800], **{"time/update": 3, "time/rest": 0.25}), processes("peer", [400])]
    header, _, line = cells(throughput.make_tables(pd.concat(rows), peers=["peer"])[1])
    assert header[4:] == ["iteration, ms", "update", "rest"]
    assert line[0] == "script" and line[4:] == ["4000", "3000 (75.0%)", "250 (6.2%)"]


def test_limits_are_shared_out_as_agent_steps():
    limits = dict(zip(throughput.LIMITS, (1.6 * throughput.AGENT_STEP, 3.2 * throughput.AGENT_STEP, 4800)))
    shown = cells(throughput.make_tables(processes("script", [800], **limits), peers=[])[2])[2]
    assert shown[4:] == ["50% of 1,600", "25% of 3,200", "17% of 4,800", "67% of 1,200", "42% of 1,920"]


def test_work_of_an_agent_step_is_the_network_s():
    agent = acppo_atari.Agent((4, 84, 84), num_actions=4)
    heads = 2 * 512 * 5 / 1e6  # left out of the constants: they depend on the game
    with FlopCounterMode(display=False) as forward:
        logits, values = agent(torch.zeros(2, 84, 84, 4, dtype=torch.uint8))
    assert forward.get_total_flops() / 2e6 == pytest.approx(throughput.FORWARD + heads)
    with FlopCounterMode(display=False) as backward:
        (logits.sum() + values.sum()).backward()
    assert backward.get_total_flops() / 2e6 == pytest.approx(throughput.BACKWARD + 2 * heads)


def test_probes_give_a_speed():
    assert throughput.probe_convolutions(torch.get_num_threads(), "float32", seconds=0.0) > 0
    assert throughput.probe_emulator("breakout", 2, 1, block=2) > 0


def test_call_prints_tables_and_adds_a_row_for_each_process(tmp_path, monkeypatch, call_main):
    names, csv = ["acppo_atari.py --c 0", f"ppo_atari.py --resume {tmp_path}"], tmp_path / "throughput.csv"
    train(ppo_atari, tmp_path, env_id="CartPole-v1", num_envs=2, num_steps=128, total_timesteps=256)
    saved = (tmp_path / "checkpoint.pt").read_bytes()
    throughput.add_rows(csv, [{"candidate": "older, with phases of its own", "time/storage": 0.5}])
    flags = "--env-id CartPole-v1 --rounds 1 --warmup 1 --window 3 --num-envs 2 --threads 2".split()
    monkeypatch.chdir(ROOT)
    printed = call_main(throughput, *names, *flags, "--csv", str(csv)).out
    assert (tmp_path / "checkpoint.pt").read_bytes() == saved  # a copy is resumed
    tables = [cells(block) for block in printed.split("\n\n") if block.startswith("|")]
    assert len(tables) == 2  # speed and phases; no limits outside Atari
    assert all([line[:4] for line in table[2:]] == [[name, "2", "2", "1"] for name in names] for table in tables)
    older, rows = (table := pd.read_csv(csv))[:1].dropna(axis=1), table[1:].reset_index()
    assert older.to_dict("list") == {"candidate": ["older, with phases of its own"], "time/storage": [0.5]}
    assert list(rows.candidate) == names and tables[0][2][4].startswith(f"{rows.steps_per_second[0]:,.0f} (")
    assert rows["peak_mb"].between(50, 5000).all()  # an interpreter with torch, and no more
    assert (rows[[f"time/{name}" for name in ("inference", "environment", "update", "kl_pass")]] > 0).all(axis=None)
    assert rows["kind"][0] == bookkeeping.processor_kind() and rows[["cpu", "commit", "torch"]].notna().all(axis=None)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ([], "name a script"),
        (["no_such.py"], "no such script"),
        (["script.py --threads 1"], "leave out --threads"),
        (["script.py", "--jobs", "1", "0"], "--jobs (1, 0): give a value in 1..10^12"),
        (["script.py", "--window", "0"], "--window 0: give "),
        (["script.py", "--env-id", "ALE/Breakout-v5", "--peer"], "a game such as Breakout"),
        (["script.py", "--cleanrl", "."], "there is no cleanrl/ppo_atari.py in it"),
    ],
)
def test_bad_input_is_refused_and_leaves_nothing(flags, said, tmp_path, call_main):
    (tmp_path / "script.py").touch()
    ended = call_main(throughput, *flags, "--csv", "x.csv")
    assert ended.status == 2 and said in ended.err
    assert [path.name for path in tmp_path.iterdir()] == ["script.py"]


def test_failing_process_ends_the_call_and_rows_before_it_stay(tmp_path, monkeypatch, call_main):
    answers, run_jobs = [[{"steps_per_second": 1.0}]], throughput.run_jobs  # the first one is not run
    monkeypatch.setattr(throughput, "run_jobs", lambda *words: answers.pop() if answers else run_jobs(*words))
    (tmp_path / "script.py").write_text("raise SystemExit(3)")
    ended = call_main(throughput, *"script.py script.py --env-id CartPole-v1 --csv x.csv".split())
    assert "(2) ended with status 3" in ended.status
    assert list(pd.read_csv("x.csv").commit) == ["unknown"]  # of the script's directory, which is no checkout
