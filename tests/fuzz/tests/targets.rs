//! Every fuzz target is in the manifest.
//!
//! `tests/fuzz/run` compiles this test together with the targets. With a test, cargo gives dependencies the same
//! features as in every other build with tests, and reuses what is already compiled.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

fn names(folder: &str) -> BTreeSet<String> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    let names = fs::read_dir(&folder).unwrap().map(|entry| entry.unwrap().path());
    names.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
}

#[test]
fn every_target_is_in_the_manifest_and_every_corpus_has_a_target() {
    let targets = names("fuzz_targets");
    let manifest = include_str!("../Cargo.toml");
    let lines = manifest.lines().filter_map(|line| line.strip_prefix("path = \"fuzz_targets/"));
    let known = lines.map(|rest| rest.strip_suffix(".rs\"").unwrap().to_owned());
    assert_eq!(known.collect::<BTreeSet<_>>(), targets);
    let strangers: Vec<_> = names("corpus").difference(&targets).cloned().collect();
    assert!(strangers.is_empty(), "seeds of no target: {strangers:?}");
}
