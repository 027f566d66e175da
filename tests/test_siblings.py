"""The two scripts are one file but for the clip range: the diff is AC-PPO, so it has a budget."""

import ast
import difflib

import acppo_atari
import ppo_atari
from conftest import ROOT

PLACES = {  # places that a hunk may touch: lines from the one to the other, the second not included
    "docstring": ('"""', "Sections: "),
    "Args": ("class Args:", "@property"),
    "clip_range": ("def clip_range(", "def surrogate("),
    "the line that calls it": ("clip = clip_range(", "pg_loss = "),
}


def lines_of(script) -> list[str]:
    with open(script.__file__, encoding="utf-8") as file:
        return file.read().splitlines()


def place_of(line_number: int, lines: list[str]) -> str:
    """Returns the name of the place that a line (from 0) belongs to, or the line itself."""
    for place, (first, end) in PLACES.items():
        start = next(i for i, line in enumerate(lines) if line.lstrip().startswith(first))
        stop = next(i for i in range(start + 1, len(lines)) if lines[i].lstrip().startswith(end))
        if start <= line_number < stop:
            return place
    return lines[line_number]


def test_the_sibling_diff_keeps_its_budget():
    base, sibling = lines_of(ppo_atari), lines_of(acppo_atari)
    opcodes = difflib.SequenceMatcher(None, base, sibling, autojunk=False).get_opcodes()
    changes = [opcode for opcode in opcodes if opcode[0] != "equal"]
    lines_out = sum(i2 - i1 for _, i1, i2, _, _ in changes)
    lines_in = sum(j2 - j1 for _, _, _, j1, j2 in changes)
    places_out = {place_of(i, base) for _, i1, i2, _, _ in changes for i in range(i1, i2)}
    places_in = {place_of(j, sibling) for _, _, _, j1, j2 in changes for j in range(j1, j2)}
    assert places_out <= PLACES.keys() and places_in <= PLACES.keys()
    assert len(changes) <= 6
    assert lines_out <= 15
    assert lines_in <= 30


def without_docstrings(script) -> list[str]:
    """A script's lines but those of its module's, classes', functions' and fields' docstrings."""
    lines = lines_of(script)
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines[node.lineno - 1 : node.end_lineno] = [None] * (node.end_lineno - node.lineno + 1)
    return [line for line in lines if line is not None]


def test_the_readme_shows_the_diff_as_it_is():
    both = without_docstrings(ppo_atari), without_docstrings(acppo_atari)
    diff = list(difflib.unified_diff(*both, n=0, lineterm=""))[2:]
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = readme.split("<!-- sibling diff -->\n```diff\n")[1].split("\n```\n<!-- end -->")[0]
    assert [line for line in shown.splitlines() if line] == [line for line in diff if not line.startswith("@@")]
