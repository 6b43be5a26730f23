//! Projects of other courses: folders `projects/NAME` with an `arena.toml`.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};

/// Returns the folder of the project `name`: `projects/NAME` with an `arena.toml`, below the
/// current folder or one of `roots`.
///
/// # Errors
/// If no such project exists; the message lists `ours` and the projects found.
pub(super) fn find(name: &str, ours: &[&str], roots: &[PathBuf]) -> Result<PathBuf> {
    let roots: Vec<PathBuf> =
        std::iter::once(PathBuf::new()).chain(roots.iter().cloned()).collect();
    let mut known = Vec::new();
    for root in &roots {
        let Ok(entries) = std::fs::read_dir(root.join("projects")) else { continue };
        for entry in entries.filter_map(std::result::Result::ok) {
            if entry.path().join("arena.toml").is_file() {
                if entry.file_name() == name {
                    return entry
                        .path()
                        .canonicalize()
                        .with_context(|| format!("cannot resolve {}", entry.path().display()));
                }
                known.push(entry.file_name().to_string_lossy().into_owned());
            }
        }
    }
    known.sort();
    known.dedup();
    let all = ours.iter().copied().chain(known.iter().map(String::as_str)).collect::<Vec<_>>();
    bail!(
        "there is no project '{name}'; there are: {}; to add one, make a folder projects/{name} with an arena.toml",
        all.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_projects_by_name() {
        let root = tempfile::tempdir().unwrap();
        let roots = [root.path().to_owned()];
        let error = |name: &str| find(name, &["p1"], &roots).unwrap_err().to_string();
        let none = "there is no project 'p2'; there are: p1; ";
        assert!(error("p2").starts_with(none), "{}", error("p2"));
        for name in ["p3", "p2"] {
            std::fs::create_dir_all(root.path().join("projects").join(name)).unwrap();
        }
        assert!(error("p2").starts_with(none), "a folder without an arena.toml is not a project");
        for name in ["p3", "p2"] {
            std::fs::write(root.path().join("projects").join(name).join("arena.toml"), "").unwrap();
        }
        assert!(find("p2", &["p1"], &roots).unwrap().ends_with("projects/p2"));
        assert!(error("p9").contains("there are: p1, p2, p3; "), "{}", error("p9"));
        assert!(error("../p2").contains("no project"), "a path is not a name");
    }
}
