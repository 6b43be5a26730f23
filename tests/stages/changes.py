"""What has changed: crates since a revision, and the inputs of heavy stages since these last passed."""

from __future__ import annotations

import datetime
import hashlib
import json
import pathlib
import re
import subprocess
from collections.abc import Mapping

from table import Stage


class Record:
    """`tests/all-passed.toml`: when each heavy stage last passed, and the hash of its inputs then.

    The hash, not the commit, decides whether a stage has changed: a commit may be squashed, or missing in a shallow
    clone.
    """

    def __init__(self, root: pathlib.Path) -> None:
        self.root = root
        self.path = root / "tests/all-passed.toml"
        self.lines: dict[str, str] = {}
        if self.path.exists():
            for line in self.path.read_text().splitlines():
                if match := re.match(r"([\w-]+) = \{", line):
                    self.lines[match[1]] = line

    def passed(self, stage: Stage) -> str | None:
        """Returns date and commit of the last pass, if the inputs are the same now."""
        line = self.lines.get(stage.name, "")
        if f'inputs = "{self.hash_of(stage)}"' not in line:
            return None
        return ", ".join(re.findall(r'(?:date|commit) = "([^"]*)"', line))

    def write(self, hashes: Mapping[str, str]) -> None:
        """Records stages that have passed."""
        if not hashes:
            return
        commit = git(self.root, "rev-parse", "--short=8", "HEAD").strip()
        commit += " and changes" if git(self.root, "status", "--porcelain", "--untracked-files=no").strip() else ""
        date = datetime.datetime.now(tz=datetime.timezone.utc).date()
        for name, value in hashes.items():
            self.lines[name] = f'{name} = {{ date = "{date}", commit = "{commit}", inputs = "{value}" }}'
        head = "# Written by `tests/run --all`: when each heavy stage last passed, and the hash of its inputs then.\n"
        self.path.write_text(head + "".join(f"{line}\n" for _, line in sorted(self.lines.items())))

    def hash_of(self, stage: Stage) -> str:
        """Returns a hash of command, toolchain, versions of crates from elsewhere, and names, modes and contents of all
        input files that git would commit."""
        digest = hashlib.sha256(stage.command.encode())
        digest.update((self.root / "rust-toolchain.toml").read_bytes())
        for package in (self.root / "Cargo.lock").read_text().split("[[package]]"):
            if "\nsource = " in package:
                digest.update(package.encode())
        names = git(self.root, "ls-files", "-z", "--cached", "--others", "--exclude-standard", "--", *stage.inputs)
        for name in sorted(set(names.split("\0")) - {""}):
            path = self.root / name
            if path.is_file():
                content = hashlib.sha256(path.read_bytes()).hexdigest()
                digest.update(f"{name}\0{path.stat().st_mode & 0o100}\0{content}\n".encode())
        return digest.hexdigest()[:32]


def crates(root: pathlib.Path, base: str) -> list[str]:
    """Returns the workspace's crates with files that differ from their state at `base`."""
    found = subprocess.run(["git", "merge-base", base, "HEAD"], cwd=root, capture_output=True, text=True)
    since = found.stdout.strip() or "HEAD"
    changed = git(root, "diff", "--name-only", since).split("\n")
    changed += git(root, "ls-files", "--others", "--exclude-standard").split("\n")
    metadata = json.loads(
        subprocess.run(
            ["cargo", "metadata", "--no-deps", "--format-version=1", "--locked"],
            cwd=root,
            check=True,
            capture_output=True,
            text=True,
        ).stdout
    )
    folders = {
        str(pathlib.Path(package["manifest_path"]).parent.relative_to(root)): str(package["name"])
        for package in metadata["packages"]
    }
    names = set()
    for file in filter(None, changed):
        owners = [folder for folder in folders if file.startswith(f"{folder}/")]
        if owners:
            names.add(folders[max(owners, key=len)])
    return sorted(names)


def git(root: pathlib.Path, *arguments: str) -> str:
    return subprocess.run(["git", *arguments], cwd=root, check=True, capture_output=True, text=True).stdout
