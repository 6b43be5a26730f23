//! Every parser that is fuzzed is known to cargo.
//!
//! `tests/fuzz/run` compiles this beside the targets: asked for a test too, cargo gives dependencies the features that they
//! have in every other build with tests, and takes what is compiled already.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

fn names(folder: &str) -> BTreeSet<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let names = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
    names.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
}

#[test]
fn every_target_is_in_the_manifest_and_seeds_are_of_a_target() {
    let targets = names("fuzz_targets");
    let manifest = include_str!("../Cargo.toml");
    let lines = manifest.lines().filter_map(|line| line.strip_prefix("path = \"fuzz_targets/"));
    let known = lines.map(|rest| rest.strip_suffix(".rs\"").unwrap().to_owned());
    assert_eq!(known.collect::<BTreeSet<_>>(), targets);
    let strangers: Vec<_> = names("corpus").difference(&targets).cloned().collect();
    assert!(strangers.is_empty(), "seeds of no target: {strangers:?}");
}
