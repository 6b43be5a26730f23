//! The rooms of the server import each other in one direction only; the order is in `src/lib.rs`.

use std::fs;
use std::path::{Path, PathBuf};

/// From top to bottom: each imports only rooms below it.
const ROOMS: [&str; 6] = ["web", "stream", "render", "poses", "flights", "scene"];
/// Rooms on the same level, which do not import each other.
const APART: [(&str, &str); 1] = [("flights", "scene")];
/// Files above all rooms.
const ABOVE: [&str; 5] = ["main", "lib", "serve", "settings", "args"];

fn files(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
    found
}

/// Returns the modules of this crate that a file imports: `crate::NAME` and `crate::{NAME, ...}`.
fn imports(text: &str) -> Vec<String> {
    let code = text.lines().filter(|line| !line.trim_start().starts_with("//"));
    let code = code.collect::<Vec<_>>().join("\n");
    let mut found = Vec::new();
    for (at, _) in code.match_indices("crate::") {
        let rest = &code[at + "crate::".len()..];
        let list = match rest.strip_prefix('{') {
            Some(list) => list.split('}').next().unwrap_or_default(),
            None => rest,
        };
        for name in list.split(',').take(if rest.starts_with('{') { usize::MAX } else { 1 }) {
            let name = name.trim_start();
            let end = name.find(|c: char| !c.is_alphanumeric() && c != '_').unwrap_or(name.len());
            found.push(name[..end].to_owned());
        }
    }
    found
}

/// Returns the room of a file, or the name of the file if it is in none.
fn room(path: &Path, source: &Path) -> String {
    let inside = path.strip_prefix(source).unwrap();
    let first = inside.components().next().unwrap().as_os_str().to_str().unwrap();
    first.trim_end_matches(".rs").to_owned()
}

/// Whether `from` may import `to`.
fn may_import(from: &str, to: &str) -> bool {
    let place = |name: &str| ROOMS.iter().position(|room| *room == name);
    let apart = |(a, b): &(&str, &str)| (from == *a && to == *b) || (from == *b && to == *a);
    match (place(from), place(to)) {
        _ if from == to || ABOVE.contains(&from) => true,
        _ if ABOVE.contains(&to) => false,
        (Some(upper), Some(lower)) => upper < lower && !APART.iter().any(apart),
        // Modules below the rooms import none of them.
        (None, Some(_)) => false,
        (_, None) => true,
    }
}

#[test]
fn no_import_runs_upwards() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut rooms_seen = 0;
    for path in files(&source) {
        let from = room(&path, &source);
        rooms_seen += usize::from(ROOMS.contains(&from.as_str()));
        for to in imports(&fs::read_to_string(&path).unwrap()) {
            assert!(
                may_import(&from, &to),
                "{}: `{from}` may not import `{to}`; the order is in src/lib.rs",
                path.display()
            );
        }
    }
    assert!(rooms_seen > 50, "the rooms have moved: {rooms_seen} files found");
}

#[test]
fn finds_an_upward_import() {
    let text = "use crate::{clock, web};\nuse crate::stream::Rooms;\n// use crate::serve;\n";
    assert_eq!(imports(text), ["clock", "web", "stream"]);
    assert!(may_import("web", "stream") && may_import("poses", "clock"));
    assert!(may_import("serve", "web") && may_import("render", "render"));
    assert!(!may_import("stream", "web") && !may_import("clock", "poses"));
    assert!(!may_import("web", "args") && !may_import("flights", "scene"));
}
