#!/usr/bin/env python3
"""Checks the words of the documents: turns of phrase that readers stumble over, and headings that are not search terms.

tests/docs/prose.py    prints each with its line; exit status 0 if there is none
"""

import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Code, quotes and links' targets are not prose.
CODE = re.compile(r"^(```|~~~).*?^\1[^\n]*$|`[^`\n]*`|<!--.*?-->|\]\([^)]*\)|\"[^\"\n]*\"|<[^>\n]*>", re.M | re.S)
RULES = [
    (r"(?<!there )\b(?:is|are|was|were) (?:no|none)\b(?! longer| more)|\bthat (?:is|are) none\b",
     "say 'is not an X', or what it is"),
    (r"\bso (?:long|many|often|far)\b(?! as| that)", "'so long', 'so many' as a measure: give the measure"),
    (r"\b(?:server|runtime|page|program|plugin|log|guard|bridge|it) (?:tells|says|knows|believes|asks|forgets)\b",
     "software prints, reports, sends, estimates"),
    (r"\b(?:whoever|nobody|somebody)\b", "name the person or the role"),
    (r"\b(?:beside|likewise|anew|hence|thither)\b", "next to, in addition to, also, again"),
    (r"\bof (?:its|their|his|her) own\b|\bof ours\b|\bas it has it\b", "own, separate"),
]
# Titles of generated tables, and the program's own words.
QUOTED = {"docs/BENCHMARKS.md": "beside", "docs/guides/course.md": "plugin knows", "docs/guides/failsafe.md": "nobody",
          "docs/guides/safety.md": "of its own", "docs/guides/scenes.md": "is NO"}
# Words that are not search terms.
HEADING = re.compile(r"^#{1,4} (?:What|Who|Whose|Where|How far|It|They)\b.*", re.M)
# Headings that tests or other documents refer to.
KEPT = ("What it sees", "What it answers", "Where the pose is withheld", "What the guard does to it")


def findings(name: str, text: str) -> list[str]:
    """Returns a line for each finding in a document."""
    # Keep the length, so that line numbers stay valid.
    prose = CODE.sub(lambda match: re.sub(r"[^\n]", " ", match[0]), text)
    found = [
        (prose.count("\n", 0, match.start()) + 1, f"'{' '.join(match[0].split())}': {advice}")
        for pattern, advice in RULES
        for match in re.finditer(pattern, prose, re.I)
        if match[0] != QUOTED.get(name)
    ]
    for match in HEADING.finditer(prose):
        if not match[0].lstrip("# ").startswith(KEPT):
            found.append((prose.count("\n", 0, match.start()) + 1, f"heading '{match[0]}': begin with the search term"))
    return [f"{name}:{line}: {what}" for line, what in sorted(found)]


def main() -> int:
    call = ["git", "ls-files", "README.md", "docs/*.md"]
    listed = subprocess.run(call, cwd=ROOT, check=True, capture_output=True, text=True).stdout.splitlines()
    documents = [name for name in listed if (ROOT / name).exists()]
    lines = [line for name in documents for line in findings(name, (ROOT / name).read_text())]
    print("\n".join(lines) or f"{len(documents)} documents: nothing found")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
