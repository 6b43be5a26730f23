//! Every dependency must have the same features for any selection of crates, so that building or testing a single crate
//! uses the dependencies that `cargo build` has compiled.

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

use cargo_metadata::MetadataCommand;

/// Crates that a normal build omits.
const LEFT_OUT: [&str; 2] = ["vizflyt-ros2", "vizflyt-fuzz"];
/// Crates that plugins and chips link, with fewer of our own features.
const SLIM: [&str; 4] = ["vizflyt-rgbd", "vizflyt-sdk", "vizflyt-c", "vizflyt-bridge"];

/// Feature sets by package and version: one for the target, one for build scripts.
type Features = BTreeMap<String, BTreeSet<String>>;

#[test]
fn dependencies_have_the_same_features_for_any_selection() {
    let whole = features(
        &["--workspace", "--exclude=vizflyt-ros2", "--exclude=vizflyt-fuzz"],
        "normal,dev,build",
    );
    let mut different = different("cargo build", &features(&[], "normal,build"), &whole);
    for package in &MetadataCommand::new().no_deps().exec().expect("cargo metadata").packages {
        let name = package.name.as_str();
        if LEFT_OUT.contains(&name) {
            continue;
        }
        let mut alone = features(&["--package", name], "normal,dev,build");
        alone.retain(|package, _| !(SLIM.contains(&name) && package.starts_with("vizflyt-")));
        different.extend(self::different(name, &alone, &whole));
    }
    assert!(
        different.is_empty(),
        "these would be compiled again; add what is missing to tests/fixtures/Cargo.toml: {different:#?}"
    );
}

/// Returns the packages that a selection compiles with features that the complete workspace does not enable.
fn different(name: &str, selected: &Features, whole: &Features) -> Vec<String> {
    let differs = |(package, sets): (&String, &BTreeSet<String>)| {
        let other = sets.difference(whole.get(package)?).next()?;
        Some(format!("{name}: {package} with [{other}], elsewhere with {:?}", whole[package]))
    };
    selected.iter().filter_map(differs).collect()
}

fn features(selection: &[&str], edges: &str) -> Features {
    let mut command = Command::new(env!("CARGO"));
    command.args([
        "tree",
        "--locked",
        "--prefix=none",
        "--no-dedupe",
        "--format={p}|{f}",
        "--edges",
        edges,
    ]);
    let output =
        command.args(selection).current_dir(vizflyt_e2e::root()).output().expect("cargo tree");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut features = Features::new();
    for line in String::from_utf8(output.stdout).expect("cargo prints text").lines() {
        // Headings of dependency kinds have no separator.
        let Some((package, set)) = line.split_once('|') else { continue };
        // Without the folder of our crates, or "(proc-macro)".
        let package = package.split(" (").next().unwrap_or(package);
        features.entry(package.to_owned()).or_default().insert(set.to_owned());
    }
    features
}
