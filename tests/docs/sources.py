#!/usr/bin/env python3
"""Checks the words of comments in the Rust sources: turns of phrase that readers stumble over, per 1,000 comment lines.

tests/docs/sources.py    prints each crate that is over a limit, with its lines; exit status 0 if there is none

The limits are about twice the highest rate of well-known projects of the field (quinn, probe-rs, rerun, brush). Crates
with fewer comments share one count.
"""

import collections
import pathlib
import re
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
# Turn of phrase, limit per 1,000 lines, advice.
RULES = [
    (r"\b(?:is|are|was|were) (?:no|none)\b(?! longer| more| less)|\bthat (?:is|are) none\b", 6,
     "say 'is not an X', or what it is"),
    (r"\b(?:so|how) (?:long|many|much|often|far|old)\b", 14, "give the measure: at most N, for N seconds"),
    (r"\b(?:tells?|told|says?|said|speaks?|knows?|knew|asks?|asked|believes?|forgets?)\b", 14,
     "software prints, reports, sends, estimates"),
    (r"\b(?:whoever|nobody|somebody|what of)\b", 4.6, "name the person, role or thing"),
    (r"\b(?:as it has it|of its own|of theirs|of ours|its own)\b", 6, "own, separate"),
    (r"^\s*//[/!]\s+(?:It|Its|They|Them|The same|Whose|Which|When|Where|By whom)\b(?:\W+\w+){0,3}\.?$", 1,
     "begin with the noun"),
    (r"\b(?:beside|besides|aside|likewise|anew|hence|thither|alike)\b", 2.6, "next to, in addition to, also, again"),
]
# Below this, one phrase is over the limit.
FEW = 400
COMMENT = re.compile(r"^\s*//[/!]?.*$", re.M)


def crates() -> dict[str, list[str]]:
    """Returns the comment lines of each crate, with file and number."""
    call = ["git", "ls-files", "*.rs"]
    files = subprocess.run(call, cwd=ROOT, check=True, capture_output=True, text=True).stdout.split()
    found = collections.defaultdict(list)
    for name in files:
        crate = "/".join(name.split("/")[:2])
        text = (ROOT / name).read_text() if (ROOT / name).exists() else ""
        for match in COMMENT.finditer(text):
            found[crate].append(f"{name}:{text.count(chr(10), 0, match.start()) + 1}: {match[0].strip()}")
    small = [crate for crate, lines in found.items() if len(lines) < FEW]
    found["small crates"] = [line for crate in small for line in found.pop(crate)]
    return found


def main() -> int:
    over = 0
    comments = crates()
    for crate, lines in sorted(comments.items()):
        for pattern, limit, advice in RULES:
            rule = re.compile(pattern, 0 if pattern.startswith("^") else re.I)
            hits = [line for line in lines if rule.search(line.split(": ", 1)[1])]
            rate = 1000 * len(hits) / len(lines)
            if rate > limit:
                over += 1
                print(f"{crate}: {rate:.1f} per 1,000 comment lines, limit {limit}: {advice}", *hits, sep="\n    ")
    print(f"{over} over a limit in {sum(map(len, comments.values()))} comment lines")
    return 1 if over else 0


if __name__ == "__main__":
    sys.exit(main())
