"""`pytest --script=my_ppo.py` holds a script of one's own to what every sibling of ppo_atari.py promises.

A plugin of pytest: conftest.py in the directory above loads it, because pytest must know an option before it looks for
tests. Selected are the tests that take a script; those marked `thesis` hold it to what PPO and AC-PPO do and are
skipped if it does that in a way of its own. At the end the diff is shown.
"""

import ast
import difflib
import os
import sys
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

PPO, ACPPO = (Path(__file__).parent.parent / name for name in ("ppo_atari.py", "acppo_atari.py"))
GIVEN = pytest.StashKey[ModuleType]()  # the script of --script


# -------------------------------------------------------------------------------------- what two scripts differ in
def lines_of(path) -> list[str]:
    return Path(path).read_text(encoding="utf-8").splitlines()


def changes(base: list[str], sibling: list[str]) -> list[tuple[int, int, int, int]]:
    """Returns the hunks (i1, i2, j1, j2) in which the lines i1 to i2 of `base` have become j1 to j2 of `sibling`."""
    opcodes = difflib.SequenceMatcher(None, base, sibling, autojunk=False).get_opcodes()
    return [span for kind, *span in opcodes if kind != "equal"]


def counts(base, sibling) -> tuple[int, int, int]:
    """Returns the lines out, the lines in and the hunks of two scripts' diff."""
    hunks = changes(lines_of(base), lines_of(sibling))
    return sum(i2 - i1 for i1, i2, _, _ in hunks), sum(j2 - j1 for _, _, j1, j2 in hunks), len(hunks)


def nearer(path) -> Path:
    """Returns the one of this project's two scripts that fewer lines of a script differ from."""
    return min((PPO, ACPPO), key=lambda base: sum(counts(base, path)[:2]))


def without_docstrings(path) -> list[str]:
    """A script's lines but those of its module's, classes', functions' and fields' docstrings."""
    lines = lines_of(path)
    for node in ast.walk(ast.parse("\n".join(lines))):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines[node.lineno - 1 : node.end_lineno] = [None] * (node.end_lineno - node.lineno + 1)
    return [line for line in lines if line is not None]


def code_diff(base, sibling) -> list[str]:
    """Returns the diff of two scripts without docstrings, hunk by hunk."""
    return list(difflib.unified_diff(*map(without_docstrings, (base, sibling)), n=0, lineterm=""))[2:]


def changed_definitions(path, base) -> set[str]:
    """Returns the names of the functions and classes of `base` that a script lacks or has in another form."""
    before, after = (
        {
            node.name: ast.unparse(node)
            for node in ast.parse(Path(script).read_text(encoding="utf-8")).body
            if isinstance(node, (ast.FunctionDef, ast.ClassDef))
        }
        for script in (base, path)
    )
    return {name for name, text in before.items() if after.get(name) != text}


# ------------------------------------------------------------------------------------------------------ the option
def load(path: Path) -> ModuleType:
    """Imports a script from anywhere, under the name of its file. Raises pytest.UsageError if it cannot be imported."""
    name = path.stem
    module = module_from_spec(spec_from_file_location(name, path, loader=SourceFileLoader(name, str(path))))
    sys.modules[name] = module  # dataclasses and `inspect` look there
    sys.path.append(str(path.parent))  # as if it had been started: it may import files beside it
    try:
        module.__spec__.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())
        raise pytest.UsageError(f"--script {path}: it cannot be imported ({said})") from None
    if missing := [needed for needed in ("Args", "Agent", "train", "main") if not hasattr(module, needed)]:
        raise pytest.UsageError(f"--script {path}: it has no {', '.join(missing)}; begin with a copy of ppo_atari.py")
    return module


def pytest_addoption(parser):
    parser.addoption("--script", metavar="FILE", help="run the tests that hold for any sibling of ppo_atari.py, on it")


def pytest_configure(config):
    if (path := config.getoption("script")) is not None:
        config.stash[GIVEN] = load(Path(os.path.abspath(config.invocation_params.dir / Path(path).expanduser())))
        config.option.reportchars += "s"  # says why a test is skipped


def pytest_collection_modifyitems(config, items):
    if (script := config.stash.get(GIVEN, None)) is None:
        return
    about_it = {item: bool({"script", "each_script"} & set(item.fixturenames)) for item in items}
    config.hook.pytest_deselected(items=[item for item in items if not about_it[item]])
    items[:] = [item for item in items if about_it[item]]
    file, own = os.path.basename(script.__file__), changed_definitions(script.__file__, nearer(script.__file__))
    for item in items:
        for marker in item.iter_markers("thesis"):
            if not marker.args:
                item.add_marker(pytest.mark.skip(reason="promised of PPO and AC-PPO alone"))
            elif changed := [name for name in marker.args if name in own]:
                item.add_marker(pytest.mark.skip(reason=f"{file} has its own {', '.join(changed)}"))


def pytest_terminal_summary(terminalreporter, config):
    if (script := config.stash.get(GIVEN, None)) is None:
        return
    base, file = nearer(script.__file__), os.path.basename(script.__file__)
    lines_out, lines_in, hunks = counts(base, script.__file__)
    size = f"{lines_out} lines out, {lines_in} in, {hunks} hunks"
    terminalreporter.section(f"{file} against {base.name}: {size}; without docstrings")
    for line in code_diff(base, script.__file__):
        terminalreporter.write_line(line)
