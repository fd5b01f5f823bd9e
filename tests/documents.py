"""What the documents show: fenced blocks of a language, and blocks that are made from results."""

import re
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]


def blocks(path: Path, language: str) -> list[str]:
    """The fenced blocks of a language in a document."""
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def marked(page: str, name: str) -> str:
    """The block of a page of the checkout between a name's marks."""
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    (block,) = re.findall(rf"<!-- {name} -->\n(.*?)\n<!-- /{name} -->", text, re.DOTALL)
    return block
