#!/usr/bin/env python3
"""Writes the bill of materials of a program built by cargo, from Cargo.lock, `cargo tree` and `cargo metadata`.

    bill.py PACKAGE --target TRIPLE [--features LIST] --version VERSION --date ISO8601 -o FOLDER

Output in FOLDER: `PACKAGE.cdx.json` (CycloneDX 1.5: every linked crate with licence, checksum and dependencies),
`copyright` (Debian's machine-readable format) and `licenses` (the licence texts of the crates, each once). Crates
with C sources (SQLite, AprilTag, zstd) represent these. Build-time dependencies are excluded.
"""

import argparse
import json
import re
import subprocess
import uuid
from pathlib import Path

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent

# SPDX names, as written in Debian's format.
DEBIAN_NAMES = {"BSD-2-Clause": "BSD-2-clause", "BSD-3-Clause": "BSD-3-clause", "MIT": "Expat", "Zlib": "zlib"}
# Licences whose texts every Debian system contains.
COMMON = {"Apache-2.0", "MPL-2.0", "GPL-2.0", "GPL-3.0", "LGPL-2.1", "LGPL-3.0", "CC0-1.0"}


def cargo(*arguments):
    """Returns the output of cargo."""
    return subprocess.run(["cargo", *arguments], cwd=ROOT, check=True, text=True, capture_output=True).stdout


def linked_crates(package, target, features):
    """Returns the (name, version) of every crate that is linked into the program."""
    lines = cargo("tree", "--locked", "--package", package, "--features", features, "--target", target,
                  "--edges", "normal,no-proc-macro", "--prefix", "none", "--format", "{p}").splitlines()
    return {(name, version.removeprefix("v")) for name, version, *_ in map(str.split, filter(None, lines))}


def expression_of(crate):
    """Returns a crate's licence as an SPDX expression, or None if it has only a file."""
    licence = crate["license"]
    # Older manifests use a slash for OR.
    return licence and re.sub(r"\s*/\s*", " OR ", licence)


def license_files(crate):
    """Returns the licence files of a crate, sorted by name."""
    folder = Path(crate["manifest_path"]).parent
    # All crates of this repository share the licence files of its root.
    folder = folder if crate["source"] else ROOT
    named = re.compile(r"(licen[cs]e|copying|copyright|notice|unlicense)([-._].*)?", re.IGNORECASE)
    return sorted(file for file in folder.iterdir() if file.is_file() and named.fullmatch(file.name))


def bill(package, crates, edges, checksums, arguments):
    """Returns the bill of materials: a document of CycloneDX 1.5."""
    def reference(crate):
        return f"pkg:cargo/{crate['name']}@{crate['version']}"

    def component(crate):
        entry = {"type": "library", "bom-ref": reference(crate), "name": crate["name"], "version": crate["version"],
                 "purl": reference(crate), "scope": "required"}
        if expression := expression_of(crate):
            entry["licenses"] = [{"expression": expression}]
        if checksum := checksums.get((crate["name"], crate["version"])):
            entry["hashes"] = [{"alg": "SHA-256", "content": checksum}]
        if crate["repository"]:
            entry["externalReferences"] = [{"type": "vcs", "url": crate["repository"]}]
        return entry

    program = next(crate for crate in crates if crate["name"] == package)
    main = component(program) | {"type": "application", "version": arguments.version}
    del main["scope"]
    properties = [{"name": "cargo:target", "value": arguments.target}]
    if arguments.features:
        properties.append({"name": "cargo:features", "value": arguments.features})
    name = f"{reference(program)}#{arguments.version}/{arguments.target}/{arguments.features}"
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "serialNumber": uuid.uuid5(uuid.NAMESPACE_URL, name).urn,
        "version": 1,
        "metadata": {"timestamp": arguments.date, "component": main, "properties": properties},
        "components": [component(crate) for crate in crates if crate is not program],
        "dependencies": [
            {"ref": reference(crate), "dependsOn": sorted(reference(on) for on in edges[crate["id"]])}
            for crate in crates
        ],
    }


def debian_expression(expression):
    """Returns an SPDX expression in Debian's format, and the names of its licences."""
    # Debian's format has no brackets: "C AND (A OR B)" becomes "A or B, and C".
    plain = re.sub(r"^([^()]+) AND (\([^()]+\))$", r"\2 AND \1", expression)
    plain = re.sub(r"\) AND ", ", AND ", plain)
    plain = re.sub(r"[()]", " ", plain)
    # Debian's format writes "A WITH B" as one name.
    plain = re.sub(r"(\S+)\s+WITH\s+(\S+)", r"\1-with-\2", plain)
    text = re.sub(r"[^\s,]+", lambda word: DEBIAN_NAMES.get(word[0], word[0]), " ".join(plain.split()))
    names = set(re.findall(r"[^\s,]+", text)) - {"OR", "AND"}
    return text.replace(" OR ", " or ").replace(" AND ", " and "), names


def copyright_file(crates):
    """Returns the text of `copyright`: VizFlyt's, then third-party crates, grouped by licence."""
    ours = (HERE / "copyright").read_text()
    by_licence = {}
    for crate in crates:
        if crate["source"]:
            by_licence.setdefault(expression_of(crate) or "see-licenses", []).append(crate)
    paragraphs = [ours.rstrip()]
    names = {"Apache-2.0", "Expat"}
    for expression, group in sorted(by_licence.items()):
        text, used = debian_expression(expression)
        names |= used
        files = [f"crates/{crate['name']}-{crate['version']}/*" for crate in group]
        authors = {re.sub(r"\s*<.*?>", "", author).strip() for crate in group for author in crate["authors"]}
        silent = {f"the authors of {crate['name']}" for crate in group if not crate["authors"]}
        paragraphs.append("Files: " + "\n ".join(files) + "\nCopyright: " +
                          "\n ".join(sorted((authors | silent) - {""})) + f"\nLicense: {text}")
    for name in sorted(names):
        if name == "Expat":
            lines = (ROOT / "LICENSE-MIT").read_text().strip().splitlines()
            body = "\n".join(f" {line}" if line.strip() else " ." for line in lines)
        elif name in COMMON:
            body = f" On Debian systems its text is in /usr/share/common-licenses/{name}."
        else:
            body = " Its text, with the copyright lines of each crate, is in\n /usr/share/doc/vizflyt/licenses.gz."
        paragraphs.append(f"License: {name}\n{body}")
    return "\n\n".join(paragraphs) + "\n"


def license_texts(crates):
    """Returns all licence texts of the crates: each once, below the names of its crates."""
    bringers = {}
    for crate in crates:
        for file in license_files(crate):
            text = file.read_text(errors="replace").strip()
            bringers.setdefault(text, set()).add(f"{crate['name']} {crate['version']}")
    parts = [f"{'=' * 78}\n{', '.join(sorted(names))}\n{'=' * 78}\n\n{text}\n"
             for text, names in sorted(bringers.items(), key=lambda item: (sorted(item[1]), item[0]))]
    return "\n".join(parts)


def main():
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("package")
    parser.add_argument("--target", required=True)
    parser.add_argument("--features", default="")
    parser.add_argument("--version", required=True)
    parser.add_argument("--date", required=True)
    parser.add_argument("-o", dest="folder", type=Path, required=True)
    arguments = parser.parse_args()

    linked = linked_crates(arguments.package, arguments.target, arguments.features)
    metadata = json.loads(cargo("metadata", "--locked", "--format-version", "1",
                                "--filter-platform", arguments.target))
    key = {crate["id"]: (crate["name"], crate["version"]) for crate in metadata["packages"]}
    crates = sorted((crate for crate in metadata["packages"] if key[crate["id"]] in linked),
                    key=lambda crate: (crate["name"], crate["version"]))
    by_id = {crate["id"]: crate for crate in crates}
    edges = {
        node["id"]: [by_id[dep["pkg"]] for dep in node["deps"]
                     if dep["pkg"] in by_id and any(kind["kind"] is None for kind in dep["dep_kinds"])]
        for node in metadata["resolve"]["nodes"] if node["id"] in by_id
    }
    # Cargo writes one key per line; a TOML parser is only part of Python from 3.11 on.
    entries = (ROOT / "Cargo.lock").read_text().split("[[package]]")[1:]
    locked = (dict(re.findall(r'^(\w+) = "(.*)"$', entry, re.MULTILINE)) for entry in entries)
    checksums = {(entry["name"], entry["version"]): entry.get("checksum") for entry in locked}

    document = bill(arguments.package, crates, edges, checksums, arguments)
    file = arguments.folder / f"{arguments.package}.cdx.json"
    file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n")
    (arguments.folder / "copyright").write_text(copyright_file(crates))
    (arguments.folder / "licenses").write_text(license_texts(crates))


if __name__ == "__main__":
    main()
