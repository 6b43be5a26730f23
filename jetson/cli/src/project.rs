//! `vizflyt.toml`: what a student's folder flies, and where. And the projects of a course: folders
//! with an `arena.toml`, found by name.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use vizflyt_runtime::config::parse_strict;
use vizflyt_scenes::projects::{self, Level};

/// The whole of `vizflyt.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Project {
    /// The plugin: `plugin.py`, `Cargo.toml`, or a program; relative to the folder.
    pub plugin: PathBuf,
    /// The simulated lab it flies in.
    #[serde(default)]
    pub lab: LabConfig,
}

/// `[lab]`: the simulated lab; the command line goes before it.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct LabConfig {
    /// forest, race, room, moving; or the path of a scene folder, an arena.toml or a scene file, relative
    /// to the folder.
    pub scene: Option<String>,
    /// Instead of a scene, a project of the course: p2, p3, p4, p5 or forest.
    project: Option<String>,
    /// Whom the project is for: ug or g.
    level: Option<String>,
    /// Seed of the generated scene and of the simulator's noise.
    pub seed: Option<u64>,
}

impl LabConfig {
    /// Returns the name of the course's project, if one is flown.
    ///
    /// # Errors
    /// If no project has this name, or a scene is given too.
    pub(crate) fn project(&self) -> Result<Option<String>> {
        let Some(name) = &self.project else { return Ok(None) };
        if self.scene.is_some() {
            bail!("{FILE} gives both a scene and the project '{name}'; remove one of them");
        }
        let project = projects::Project::named(name).with_context(|| FILE.to_owned())?;
        Ok(Some(project.name().to_owned()))
    }

    /// Returns whom the project is for, if that is said.
    ///
    /// # Errors
    /// If there is no such level.
    pub(crate) fn level(&self) -> Result<Option<Level>> {
        self.level
            .as_deref()
            .map(|level| level.parse().with_context(|| FILE.to_owned()))
            .transpose()
    }
}

/// Its file's name.
pub(crate) const FILE: &str = "vizflyt.toml";

impl Project {
    /// Reads the file in `folder`; `None` if there is none. Paths are returned from here.
    ///
    /// # Errors
    /// A file that cannot be read, or says what it must not.
    pub(crate) fn read(folder: &Path) -> Result<Option<Self>> {
        let file = folder.join(FILE);
        if !file.is_file() {
            return Ok(None);
        }
        let text = std::fs::read_to_string(&file)
            .with_context(|| format!("cannot read {}", file.display()))?;
        let mut project = Self::parse(&text).with_context(|| format!("{}", file.display()))?;
        project.plugin = folder.join(&project.plugin);
        if let Some(scene) = &mut project.lab.scene
            && folder.join(&*scene).exists()
        {
            *scene = folder.join(&*scene).display().to_string();
        }
        Ok(Some(project))
    }

    /// Returns what `text` says.
    fn parse(text: &str) -> Result<Self> {
        Ok(parse_strict(text)?)
    }
}

/// Returns the folder of the course's project `name`: `projects/NAME` with an `arena.toml`, in the
/// folder people work in or in one of `roots`.
///
/// # Errors
/// If there is none of that name; the sentence says which there are.
pub(crate) fn course(name: &str, roots: &[PathBuf]) -> Result<PathBuf> {
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
        let error = |name: &str| course(name, &roots).unwrap_err().to_string();
        assert!(error("p2").contains("no project 'p2'") && error("p2").contains("no other"));
        for name in ["p3", "p2"] {
            std::fs::create_dir_all(root.path().join("projects").join(name)).unwrap();
        }
        assert!(error("p2").contains("no other"), "a folder without an arena.toml is no project");
        for name in ["p3", "p2"] {
            std::fs::write(root.path().join("projects").join(name).join("arena.toml"), "").unwrap();
        }
        assert!(course("p2", &roots).unwrap().ends_with("projects/p2"));
        assert!(error("p9").ends_with("there are: p2, p3"), "{}", error("p9"));
        assert!(error("../p2").contains("no project"), "no path");
    }

    #[test]
    fn paths_are_relative_to_the_folder() {
        let root = tempfile::tempdir().unwrap();
        assert_eq!(Project::read(root.path()).unwrap(), None);
        let text = "plugin = \"plugin.py\"\n[lab]\nscene = \"forest\"\nseed = 3\n";
        std::fs::write(root.path().join(FILE), text).unwrap();
        let project = Project::read(root.path()).unwrap().unwrap();
        assert_eq!(project.plugin, root.path().join("plugin.py"));
        assert_eq!((project.lab.scene.as_deref(), project.lab.seed), (Some("forest"), Some(3)));
        std::fs::create_dir(root.path().join("forest")).unwrap();
        let project = Project::read(root.path()).unwrap().unwrap();
        assert_eq!(project.lab.scene, Some(root.path().join("forest").display().to_string()));
        for (text, part) in [
            ("", "plugin"),
            ("plugin = \"a\"\n[lab]\nscen = \"x\"\n", "did you mean 'scene'"),
            ("plugin = \"a\"\n[lap]\n", "did you mean 'lab'"),
            ("plugin = \"a\"\n[lab]\nseed = -1\n", "line 3"),
        ] {
            let error = format!("{:#}", Project::parse(text).unwrap_err());
            assert!(error.contains(part), "{text:?}: {error}");
        }
    }
}
