#!/usr/bin/env python3
"""Checks the pages of the documentation site: Markdown that was not rendered, images, and addresses on other computers.

docs/site/check.py FOLDER    prints the faults; exit status 0 if there is none
"""

import html.parser
import pathlib
import re
import sys

# As Markdown: a fence, a row of a table, an item of a list without an empty line before it, bold text, an image.
RAW = re.compile(r"```|^\s*\|.*\||^(?:-|\d+\.) \S|\*\*\w|!\[", re.M)
LOADS = {"img": "src", "script": "src", "source": "src", "iframe": "src", "link": "href"}


class Page(html.parser.HTMLParser):
    def __init__(self, path: pathlib.Path):
        super().__init__()
        self.path = path
        self.is_paragraph = False
        self.depth = 0
        self.headings = 0
        self.faults: list[str] = []
        self.feed(path.read_text())
        if self.headings != 1:
            self.faults.append(f"{self.headings} titles instead of one")

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.depth += tag in ("code", "strong")
        self.is_paragraph |= tag == "p"
        self.headings += tag == "h1"
        address = given.get(LOADS.get(tag, "")) or ""
        is_loaded = tag != "link" or given.get("rel") in ("stylesheet", "icon", "preload")
        if is_loaded and re.match(r"(https?:)?//", address):
            self.faults.append(f"loads {address}")
        if tag == "img" and not (self.path.parent / address).is_file():
            self.faults.append(f"no image {address}")
        if tag == "img" and not given.get("alt"):
            self.faults.append(f"no description of the image {address}")
        if given.get("data-md-component") == "source":
            self.faults.append("its link to the repository loads figures from there")

    def handle_endtag(self, tag: str) -> None:
        self.depth -= tag in ("code", "strong")
        self.is_paragraph &= tag != "p"

    def handle_data(self, data: str) -> None:
        if self.is_paragraph and not self.depth and (raw := RAW.search(data)):
            self.faults.append(f"Markdown that was not rendered: {data[raw.start():][:60]!r}")


def main() -> int:
    site = pathlib.Path(sys.argv[1])
    # The page of a missing address has no title.
    pages = [Page(path) for path in sorted(site.rglob("index.html"))]
    for page in pages:
        for fault in page.faults:
            print(f"{page.path.relative_to(site)}: {fault}", file=sys.stderr)
    return 1 if any(page.faults for page in pages) else 0


if __name__ == "__main__":
    sys.exit(main())
