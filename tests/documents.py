"""What the documents show: fenced blocks of a language, and blocks that are made from results."""

import re
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
README, DOCS = CHECKOUT / "README.md", CHECKOUT / "docs"
_MADE = {"_build", "api", "notebooks"}
PAGES = [README, *sorted(page for page in DOCS.rglob("*.md") if page.relative_to(DOCS).parts[0] not in _MADE)]
PAGE_NAMES = [str(page.relative_to(CHECKOUT)) for page in PAGES]


def blocks(path: Path, language: str) -> list[str]:
    """The fenced blocks of a language in a document."""
    return re.findall(rf"^```{language}\n(.*?)^```$", path.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def marked(page: str, name: str) -> str:
    """The block of a page of the checkout between a name's marks."""
    text = (CHECKOUT / page).read_text(encoding="utf-8")
    (block,) = re.findall(rf"<!-- {name} -->\n(.*?)\n<!-- /{name} -->", text, re.DOTALL)
    return block
