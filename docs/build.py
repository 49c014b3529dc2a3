"""Build the documentation site into site/ and check it; exit status 1 if anything is wrong.

python docs/build.py

Zensical's strict mode refuses broken links and anchors in the Markdown. Checked here beside it: what it prints and lets
pass, every link and anchor of the pages as built (those from docstrings too), references that were left as text, and
whatever a page would ask another server for.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

ROOT = Path(__file__).parents[1]
SITE = ROOT / "site"
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
LOADED = {"script": "src", "img": "src", "iframe": "src", "source": "src", "link": "href"}


class Page(HTMLParser):
    """The anchors, links, loaded files and visible text outside of code of one page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.text: list[str] = []
        self._silent = 0
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        """Collect what a tag names, links to or loads."""
        given = {key: value or "" for key, value in attributes}
        self.anchors |= {given[key] for key in ("id", "name") if key in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        if tag in LOADED and LOADED[tag] in given and given.get("rel") not in ("canonical", "prev", "next"):
            self.loads.append(given[LOADED[tag]])
        self._silent += tag in ("code", "script", "style")

    def handle_endtag(self, tag: str) -> None:
        """Leave code and scripts."""
        self._silent -= tag in ("code", "script", "style")

    def handle_data(self, data: str) -> None:
        """Collect text that is read as text."""
        if not self._silent:
            self.text.append(data)


def complaints(pages: dict[Path, Page]) -> Iterator[str]:
    """Yield what is wrong with the pages as they were built."""
    for path, page in pages.items():
        name = path.relative_to(SITE)
        for address in page.loads:
            if urlsplit(address).netloc:
                yield f"{name}: loads {address} from another server"
        for address in page.links + page.loads:
            parts = urlsplit(address)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            target = target / "index.html" if target.is_dir() else target
            if not target.exists():
                yield f"{name}: link to {address}, which is not there"
            elif parts.fragment and target in pages and unquote(parts.fragment) not in pages[target].anchors:
                yield f"{name}: link to {address}, which has no such anchor"
        for text in page.text:
            if "][" in text:
                yield f"{name}: a reference was left as text: {text.strip()[:80]}"


def main() -> int:
    """Build and check; return the exit status."""
    words = [str(Path(sys.executable).with_name("zensical")), "build", "--strict", "--clean"]
    built = subprocess.run(words, cwd=ROOT, capture_output=True, text=True)
    said = COLOURS.sub("", built.stdout + built.stderr)
    wrong = [line for line in said.splitlines() if line.startswith(("griffe:", "Warning"))]
    if built.returncode or wrong:
        print(said)
        return 1
    pages = {path: Page(path) for path in sorted(SITE.rglob("*.html")) if path.name != "404.html"}
    wrong = sorted(set(complaints(pages)))
    print("\n".join(wrong) if wrong else f"{len(pages)} pages in {SITE}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
