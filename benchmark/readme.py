"""Markdown tables, and the parts of the READMEs that commands write: from `<!-- NAME -->` to `<!-- end NAME -->`."""

import re
from pathlib import Path

from bookkeeping import write_file


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [columns, ["-"] * len(columns), *rows]) + "\n"


def split_readme(readme: Path, name: str) -> list[str] | None:
    """Returns the text before the generated part, the part, and the text after it; None unless it is there once."""
    text = readme.read_text(encoding="utf-8") if readme.exists() else ""
    parts = re.split(f"<!-- {name} -->\n(.*?)<!-- end {name} -->", text, flags=re.DOTALL)
    return parts if len(parts) == 3 else None


def write_part(readme: Path, name: str, part: str) -> bool:
    """Replaces the generated part of a file; returns whether it has one."""
    if parts := split_readme(readme, name):
        write_file(readme, f"{parts[0]}<!-- {name} -->\n{part}<!-- end {name} -->{parts[2]}")
    return parts is not None
