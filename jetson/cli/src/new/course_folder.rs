//! Projects of a course that is not ours: folders `projects/NAME` with an `arena.toml`.

use std::path::PathBuf;

use anyhow::{Context, Result, bail};

/// Returns the folder of the course's project `name`: `projects/NAME` with an `arena.toml`, in the
/// folder people work in or in one of `roots`.
///
/// # Errors
/// If there is none of that name; the sentence lists those that exist.
pub(super) fn find(name: &str, roots: &[PathBuf]) -> Result<PathBuf> {
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
    if known.is_empty() {
        bail!(
            "there is no project '{name}': no folder projects/{name} with an arena.toml, and no \
             other project either; leave --project out to start with the forest"
        );
    }
    bail!("there is no project '{name}'; there are: {}", known.join(", "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn projects_of_the_course_are_found_by_name() {
        let root = tempfile::tempdir().unwrap();
        let roots = [root.path().to_owned()];
        let error = |name: &str| find(name, &roots).unwrap_err().to_string();
        assert!(error("p2").contains("no project 'p2'") && error("p2").contains("no other"));
        for name in ["p3", "p2"] {
            std::fs::create_dir_all(root.path().join("projects").join(name)).unwrap();
        }
        assert!(error("p2").contains("no other"), "a folder without an arena.toml is no project");
        for name in ["p3", "p2"] {
            std::fs::write(root.path().join("projects").join(name).join("arena.toml"), "").unwrap();
        }
        assert!(find("p2", &roots).unwrap().ends_with("projects/p2"));
        assert!(error("p9").ends_with("there are: p2, p3"), "{}", error("p9"));
        assert!(error("../p2").contains("no project"), "no path");
    }
}
