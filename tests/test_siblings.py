"""The two scripts are one file but for the clip range: the diff is AC-PPO, so it has a budget.

Other siblings, which `--script` names, are imported from anywhere, or refused.
"""

import ast
import dataclasses
import re
import sys
from pathlib import Path

import pytest

from conftest import ROOT
from siblings import ACPPO, PPO, changes, code_diff, lines_of, load

PLACES = {  # places that a hunk may touch: lines from the one to the other, the second not included
    "docstring": ('"""', "Sections: "),
    "Args": ("class Args(", "@property"),
    "clip_range": ("def clip_range(", "def surrogate("),
    "the line that calls it": ("clip = clip_range(", "pg_loss = "),
}


def place_of(line_number: int, lines: list[str]) -> str:
    """Returns the name of the place that a line (from 0) belongs to, or the line itself."""
    for place, (first, end) in PLACES.items():
        start = next(i for i, line in enumerate(lines) if line.lstrip().startswith(first))
        stop = next(i for i in range(start + 1, len(lines)) if lines[i].lstrip().startswith(end))
        if start <= line_number < stop:
            return place
    return lines[line_number]


def test_the_sibling_diff_keeps_its_budget():
    base, sibling = lines_of(PPO), lines_of(ACPPO)
    hunks = changes(base, sibling)
    lines_out = [i for i1, i2, _, _ in hunks for i in range(i1, i2)]
    lines_in = [j for _, _, j1, j2 in hunks for j in range(j1, j2)]
    assert {place_of(i, base) for i in lines_out} | {place_of(j, sibling) for j in lines_in} <= PLACES.keys()
    assert len(hunks) <= 6
    assert len(lines_out) <= 15
    assert len(lines_in) <= 30


def test_the_readme_shows_the_diff_as_it_is():
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = readme.split("<!-- sibling diff -->\n```diff\n")[1].split("\n```\n<!-- end -->")[0]
    diff = [line for line in code_diff(PPO, ACPPO) if not line.startswith("@@")]
    assert [line for line in shown.splitlines() if line] == diff


def test_every_argument_is_read_by_the_script_or_a_file_beside_it(each_script):
    """A flag that nothing reads would be accepted, logged, and change nothing."""
    own = Path(each_script.__file__)
    imported = {
        getattr(value, "__module__", None) or getattr(value, "__name__", "") for value in vars(each_script).values()
    }
    files = {Path(getattr(sys.modules.get(name), "__file__", None) or own) for name in imported}
    read = {
        node.attr
        for file in files
        if file.parent in (own.parent, ROOT)
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute)
    }
    assert {field.name for field in dataclasses.fields(each_script.Args)} <= read


@pytest.mark.parametrize(
    ("text", "said"), [("1 / 0", "(ZeroDivisionError: "), ("x = 1", "has no Args, Agent, train, main")]
)
def test_a_script_that_is_no_sibling_is_refused(text, said, tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    path = tmp_path / "no_sibling.py"
    path.write_text(text)
    with pytest.raises(pytest.UsageError, match=re.escape(said)):
        load(path)


def test_a_script_from_anywhere_can_import_the_files_beside_it(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "idea_beside_it.py").write_text("EPSILON = 0.3")
    own = "from idea_beside_it import EPSILON\n\n\ndef clip_range("
    (tmp_path / "my idea.py").write_text(PPO.read_text(encoding="utf-8").replace("def clip_range(", own))
    script = load(tmp_path / "my idea.py")
    assert (script.__name__, script.EPSILON, script.Args().exp_name) == ("my idea", 0.3, "my idea")
