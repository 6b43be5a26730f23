//! `vizflyt.toml`: plugin of a student's folder, and its simulated lab.

use std::path::{Component, Path, PathBuf};

use anyhow::{Context, Result, bail};
use serde::Deserialize;
use vizflyt_scenes::projects::{CourseProject, Level};

use crate::door::Door;

/// Content of `vizflyt.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PluginManifest {
    /// Plugin file: `plugin.py`, `Cargo.toml`, or a program; relative to the folder.
    pub plugin: PathBuf,
    /// Simulated lab of the plugin.
    #[serde(default)]
    pub lab: LabConfig,
}

/// `[lab]`: simulated lab; options of the command line take precedence.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LabConfig {
    /// Generated scene, or the path of a scene folder, an arena.toml or a scene file, relative to
    /// the folder.
    pub scene: Option<String>,
    /// Course project instead of a scene, or the path of a project file, relative to the folder.
    project: Option<String>,
    /// Level of the project: ug or g.
    level: Option<String>,
    /// Seed of the generated scene and of the simulator's noise.
    pub seed: Option<u64>,
}

impl LabConfig {
    /// Returns the name of the course project, if one is set.
    ///
    /// # Errors
    /// If no project has this name, or a scene is also set.
    pub fn project(&self) -> Result<Option<String>> {
        let Some(name) = &self.project else { return Ok(None) };
        if self.scene.is_some() {
            bail!("{FILE} gives both a scene and the project '{name}'; remove one of them");
        }
        CourseProject::find(name).with_context(|| FILE.to_owned())?;
        Ok(Some(name.clone()))
    }

    /// Returns the level, if one is set.
    ///
    /// # Errors
    /// If the level does not exist.
    pub fn level(&self) -> Result<Option<Level>> {
        self.level
            .as_deref()
            .map(|level| level.parse().with_context(|| FILE.to_owned()))
            .transpose()
    }
}

/// File name.
pub const FILE: &str = "vizflyt.toml";

impl PluginManifest {
    /// Reads the file in `folder`; `None` if there is none. Returned paths are relative to the
    /// current folder.
    ///
    /// # Errors
    /// If the file cannot be read, or has invalid settings.
    pub fn read(folder: &Path) -> Result<Option<Self>> {
        let file = folder.join(FILE);
        if file.symlink_metadata().is_err() {
            return Ok(None);
        }
        let text = std::io::read_to_string(Door::open(folder)?.file(Path::new(FILE))?)
            .with_context(|| format!("cannot read {}", file.display()))?;
        let mut manifest = Self::parse(&text).with_context(|| format!("{}", file.display()))?;
        manifest.plugin = beneath(folder, &manifest.plugin)
            .with_context(|| format!("{}: plugin", file.display()))?;
        let LabConfig { scene, project, .. } = &mut manifest.lab;
        // Path of a project file; a project's name is not a path.
        let is_file =
            |name: &&mut String| Path::new(&**name).extension().is_some_and(|end| end == "toml");
        let project = project.iter_mut().filter(is_file);
        for place in scene.iter_mut().chain(project) {
            if folder.join(&*place).exists() {
                *place = folder.join(&*place).display().to_string();
            }
        }
        Ok(Some(manifest))
    }

    /// Parses the manifest in `text`.
    fn parse(text: &str) -> Result<Self> {
        Ok(vizflyt_toml::parse(text)?)
    }
}

/// Returns the path of `file` in `folder`.
///
/// # Errors
/// If it leads out of the folder, also through a symbolic link: a grade signs the folder's files.
fn beneath(folder: &Path, file: &Path) -> Result<PathBuf> {
    let path = folder.join(file);
    let is_inside = match (folder.canonicalize(), path.canonicalize()) {
        (Ok(folder), Ok(path)) => path.starts_with(folder),
        // The file does not exist; reported later.
        _ => file.components().all(|part| matches!(part, Component::Normal(_) | Component::CurDir)),
    };
    if !is_inside {
        bail!("'{}' is not in this folder; move the file into it", file.display());
    }
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_a_plugin_outside_the_folder() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("hand-in");
        std::fs::create_dir(&folder).unwrap();
        let other = root.path().join("other.py");
        std::fs::write(&other, "").unwrap();
        std::os::unix::fs::symlink(&other, folder.join("link.py")).unwrap();
        std::fs::write(folder.join("plugin.py"), "").unwrap();
        let absolute = other.display().to_string();
        for plugin in [&*absolute, "../other.py", "link.py", "../absent.py", "/absent.py"] {
            std::fs::write(folder.join(FILE), format!("plugin = \"{plugin}\"\n")).unwrap();
            let error = format!("{:#}", PluginManifest::read(&folder).unwrap_err());
            assert!(error.contains("is not in this folder"), "{plugin}: {error}");
        }
        for plugin in ["plugin.py", "./plugin.py", "absent.py"] {
            std::fs::write(folder.join(FILE), format!("plugin = \"{plugin}\"\n")).unwrap();
            assert!(PluginManifest::read(&folder).is_ok(), "{plugin}");
        }
    }

    #[test]
    fn resolves_paths_relative_to_the_folder() {
        let root = tempfile::tempdir().unwrap();
        assert_eq!(PluginManifest::read(root.path()).unwrap(), None);
        let text = "plugin = \"plugin.py\"\n[lab]\nscene = \"forest\"\nseed = 3\n";
        std::fs::write(root.path().join(FILE), text).unwrap();
        let manifest = PluginManifest::read(root.path()).unwrap().unwrap();
        assert_eq!(manifest.plugin, root.path().join("plugin.py"));
        assert_eq!((manifest.lab.scene.as_deref(), manifest.lab.seed), (Some("forest"), Some(3)));
        std::fs::create_dir(root.path().join("forest")).unwrap();
        let manifest = PluginManifest::read(root.path()).unwrap().unwrap();
        assert_eq!(manifest.lab.scene, Some(root.path().join("forest").display().to_string()));
        let own = "plugin = \"plugin.py\"\n[lab]\nproject = \"own.toml\"\n";
        std::fs::write(root.path().join(FILE), own).unwrap();
        std::fs::write(root.path().join("own.toml"), "title = 1").unwrap();
        let manifest = PluginManifest::read(root.path()).unwrap().unwrap();
        let error = format!("{:#}", manifest.lab.project().unwrap_err());
        assert!(error.contains(&root.path().join("own.toml").display().to_string()), "{error}");
        for (text, part) in [
            ("", "plugin"),
            ("plugin = \"a\"\n[lab]\nscen = \"x\"\n", "did you mean 'scene'"),
            ("plugin = \"a\"\n[lap]\n", "did you mean 'lab'"),
            ("plugin = \"a\"\n[lab]\nseed = -1\n", "line 3"),
        ] {
            let error = format!("{:#}", PluginManifest::parse(text).unwrap_err());
            assert!(error.contains(part), "{text:?}: {error}");
        }
    }
}
