"""The command lines of these programs: tyro's, without what neither a CSV nor an event file can hold."""

import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # so that they are found from anywhere
from bookkeeping import flag, in_utf8, parse, refuse


def parse_arguments(args_class: Callable, description: str):
    """Parses the command line. Ends the program with status 2 at a name that is not UTF-8, or a path below one."""
    args = parse(args_class, description=description)
    for name, value in vars(args).items():
        for one in value if isinstance(value, tuple) else [value]:
            text = str(one.absolute() if isinstance(one, Path) else one)
            try:
                in_utf8(text, errors="strict")
            except UnicodeDecodeError:
                refuse(flag(name, text), "give it in UTF-8")
    return args
