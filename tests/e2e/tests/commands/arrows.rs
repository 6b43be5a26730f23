//! The imports of crates in docs/ARCHITECTURE.md, compared with cargo's own metadata.

use std::collections::BTreeSet;

use cargo_metadata::{DependencyKind, MetadataCommand};

/// (crate, our crates that it may import).
const ARROWS: &[(&str, &[&str])] = &[
    ("vizflyt-protocol", &[]),
    ("vizflyt-rgbd", &["vizflyt-protocol"]),
    ("vizflyt-toml", &[]),
    ("vizflyt-trust", &["vizflyt-protocol"]),
    ("vizflyt-process", &[]),
    ("vizflyt-splat", &["vizflyt-protocol"]),
    ("vizflyt-arena", &["vizflyt-protocol", "vizflyt-toml"]),
    ("vizflyt-simulator", &["vizflyt-protocol", "vizflyt-process"]),
    ("vizflyt-bridge", &["vizflyt-protocol"]),
    ("vizflyt-sdk", &["vizflyt-protocol"]),
    ("vizflyt-tags", &["vizflyt-protocol", "vizflyt-toml"]),
    ("vizflyt-avoid", &["vizflyt-sdk"]),
    ("vizflyt-race", &["vizflyt-sdk"]),
    // It links its own DDS library, which no other crate should.
    ("vizflyt-ros2", &["vizflyt-sdk", "vizflyt-rgbd"]),
    ("vizflyt-c", &["vizflyt-sdk"]),
    // The generator contains the true geometry. The server must never have it, so it does not import scenes.
    ("vizflyt-scenes", &["vizflyt-protocol", "vizflyt-splat", "vizflyt-arena", "vizflyt-toml"]),
    ("vizflyt-twin", &["vizflyt-protocol", "vizflyt-splat"]),
    (
        "vizflyt-server",
        &[
            "vizflyt-protocol",
            "vizflyt-rgbd",
            "vizflyt-toml",
            "vizflyt-trust",
            "vizflyt-process",
            "vizflyt-splat",
            "vizflyt-arena",
        ],
    ),
    ("vizflyt-guardian", &["vizflyt-protocol"]),
    (
        "vizflyt-studio",
        &[
            "vizflyt-protocol",
            "vizflyt-rgbd",
            "vizflyt-toml",
            "vizflyt-trust",
            "vizflyt-process",
            "vizflyt-splat",
            "vizflyt-arena",
            "vizflyt-scenes",
            "vizflyt-twin",
            "vizflyt-tags",
            "vizflyt-server",
            "vizflyt-runtime",
        ],
    ),
    (
        "vizflyt-gym",
        &[
            "vizflyt-protocol",
            "vizflyt-splat",
            "vizflyt-arena",
            "vizflyt-scenes",
            "vizflyt-server",
            "vizflyt-studio",
            "vizflyt-simulator",
        ],
    ),
    (
        "vizflyt-grading",
        &[
            "vizflyt-protocol",
            "vizflyt-toml",
            "vizflyt-rgbd",
            "vizflyt-trust",
            "vizflyt-process",
            "vizflyt-splat",
            "vizflyt-arena",
            "vizflyt-scenes",
            "vizflyt-server",
            "vizflyt-studio",
            "vizflyt-runtime",
            "vizflyt-simulator",
            "vizflyt-sdk",
        ],
    ),
    (
        "vizflyt-runtime",
        &[
            "vizflyt-protocol",
            "vizflyt-rgbd",
            "vizflyt-toml",
            "vizflyt-trust",
            "vizflyt-process",
            "vizflyt-sdk",
            "vizflyt-guardian",
        ],
    ),
    (
        "vizflyt",
        &[
            "vizflyt-protocol",
            "vizflyt-rgbd",
            "vizflyt-toml",
            "vizflyt-trust",
            "vizflyt-process",
            "vizflyt-splat",
            "vizflyt-arena",
            "vizflyt-scenes",
            "vizflyt-server",
            "vizflyt-studio",
            "vizflyt-runtime",
            "vizflyt-guardian",
            "vizflyt-gym",
            "vizflyt-grading",
            "vizflyt-simulator",
            "vizflyt-bridge",
            "vizflyt-sdk",
            "vizflyt-tags",
            "vizflyt-avoid",
            "vizflyt-race",
            "vizflyt-ros2",
        ],
    ),
    ("vizflyt-e2e", &[]),
    // Only for tests: dev-dependencies are not checked.
    ("vizflyt-fixtures", &[]),
    (
        "vizflyt-fuzz",
        &[
            "vizflyt-protocol",
            "vizflyt-rgbd",
            "vizflyt-trust",
            "vizflyt-splat",
            "vizflyt-arena",
            "vizflyt-twin",
            "vizflyt-server",
            "vizflyt-runtime",
            "vizflyt-ros2",
            "vizflyt-guardian",
            "vizflyt-grading",
            "vizflyt-simulator",
            "vizflyt-bridge",
            "vizflyt-tags",
        ],
    ),
];

#[test]
fn every_import_is_an_arrow_of_the_architecture() {
    let metadata = MetadataCommand::new()
        .manifest_path(vizflyt_e2e::root().join("Cargo.toml"))
        .no_deps()
        .exec()
        .expect("cargo metadata runs");
    let ours: BTreeSet<&str> =
        metadata.workspace_packages().iter().map(|package| package.name.as_str()).collect();
    let listed: BTreeSet<&str> = ARROWS.iter().map(|&(name, _)| name).collect();
    assert_eq!(ours, listed, "a crate was added or removed: give it its arrows here and in docs/");
    for package in metadata.workspace_packages() {
        let (_, allowed) = ARROWS.iter().find(|(name, _)| *name == package.name.as_str()).unwrap();
        for dependency in &package.dependencies {
            let test_only = dependency.kind == DependencyKind::Development;
            if !test_only && ours.contains(dependency.name.as_str()) {
                assert!(
                    allowed.contains(&dependency.name.as_str()),
                    "{} may not import {}; docs/ARCHITECTURE.md lists the imports",
                    package.name,
                    dependency.name
                );
            }
        }
    }
}
