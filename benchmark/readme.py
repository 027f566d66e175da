"""Markdown tables, and the parts of a page that a command writes, from `<!-- NAME -->` to `<!-- end NAME -->`."""

import re
from pathlib import Path

from bookkeeping import usage_error, write_file

NEW_PAGE = "# Results\n\n<!-- verdicts -->\n<!-- end verdicts -->\n\n<!-- results -->\n<!-- end results -->\n"


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [columns, ["-"] * len(columns), *rows]) + "\n"


def write_parts(page: Path, **parts: str) -> None:
    """Replaces the generated parts of a page, NAME=TEXT, which it must have if it exists."""
    text = page.read_text(encoding="utf-8") if page.exists() else NEW_PAGE
    for name, part in parts.items():
        around = re.split(f"(?<=<!-- {name} -->\n).*?(?=<!-- end {name} -->)", text, flags=re.DOTALL)
        if len(around) != 2:
            usage_error(str(page), f"has no <!-- {name} --> … <!-- end {name} -->, once, to write between")
        text = part.join(around)
    write_file(page, text)
    print(page)
