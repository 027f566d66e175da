"""Markdown tables, and the part of a page that a command writes, from `<!-- results -->` to `<!-- end results -->`."""

import re
from pathlib import Path

from bookkeeping import usage_error, write_file

NEW_PAGE = "# Results\n\n<!-- results -->\n<!-- end results -->\n"


def markdown(columns: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in [columns, ["-"] * len(columns), *rows]) + "\n"


def write_part(page: Path, part: str) -> None:
    """Replaces the generated part of a page, which must have one if it exists."""
    text = page.read_text(encoding="utf-8") if page.exists() else NEW_PAGE
    around = re.split("(?<=<!-- results -->\n).*?(?=<!-- end results -->)", text, flags=re.DOTALL)
    if len(around) != 2:
        usage_error(str(page), "has no <!-- results --> … <!-- end results -->, once, to write between")
    write_file(page, part.join(around))
    print(page)
