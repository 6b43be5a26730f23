//! Plugin of a grade: its files are read once, through the [door](crate::door). Check, build and each flight get a copy
//! of their own, so that no flight finds traces of another one.
//!
//! ```text
//! Plugin ── read ──▶ Submission ── check, build ──▶ GradedPlugin ── copy ──▶ FlightCopy, for one flight
//! ```

use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use tempfile::TempDir;
use vizflyt_runtime::supervisor::PluginLimits;

use super::{Plugin, PluginKind, cargo, check_python, python_of};
use crate::door::{self, Door, Files};
use crate::keys;

/// Folders of the system. No student can write there, so their programs are not copied.
const SYSTEM: [&str; 7] = ["/usr", "/bin", "/sbin", "/lib", "/opt", "/nix", "/gnu"];
/// Folder of a built program, relative to its Cargo project.
const BUILT: &str = "target/release";

/// A plugin, and its files if they are a student's.
pub(crate) struct Submission<'a> {
    plugin: &'a Plugin,
    own: Option<OwnFiles>,
}

struct OwnFiles {
    files: Files,
    /// The student's folder, without links.
    root: PathBuf,
    /// Script, program or folder of the Cargo project, relative to `root`.
    main: PathBuf,
}

/// A plugin that was checked or built.
pub(crate) struct GradedPlugin {
    own: Option<OwnFiles>,
    /// Command without the path of the plugin's own program or script, which follows it.
    command: Vec<OsString>,
    limits: PluginLimits,
}

/// Copy of a plugin for one flight, removed when dropped.
pub(crate) struct FlightCopy {
    pub command: Vec<OsString>,
    pub limits: PluginLimits,
    _folder: Option<TempDir>,
}

impl<'a> Submission<'a> {
    /// Reads the plugin's files except those in `except`.
    ///
    /// # Errors
    /// If they contain a link, or exceed a limit of submissions.
    pub(crate) fn read(plugin: &'a Plugin, except: &[PathBuf]) -> Result<Self> {
        let typed = Path::new(&plugin.name);
        let main = match &plugin.kind {
            PluginKind::BuiltIn => return Ok(Self { plugin, own: None }),
            PluginKind::Program(path) if !path.is_file() => return Ok(Self { plugin, own: None }),
            PluginKind::Cargo(folder) if folder == Path::new("") => Path::new("."),
            PluginKind::Script(path) | PluginKind::Cargo(path) | PluginKind::Program(path) => path,
        };
        let cannot = || format!("cannot read {}", main.display());
        let (root, main) = if typed.is_dir() {
            let main = main.strip_prefix(typed).with_context(cannot)?;
            (typed.canonicalize().with_context(cannot)?, main.components().collect())
        } else {
            let full = main.canonicalize().with_context(cannot)?;
            if let PluginKind::Cargo(_) = &plugin.kind {
                (full, PathBuf::new())
            } else {
                let name = full.file_name().with_context(cannot)?.into();
                (full.parent().with_context(cannot)?.to_owned(), name)
            }
        };
        let is_program = matches!(plugin.kind, PluginKind::Program(_));
        if is_program && SYSTEM.iter().any(|folder| root.starts_with(folder)) {
            return Ok(Self { plugin, own: None });
        }
        let door = Door::open(&root)?;
        let files = if is_alone(&root, is_program) {
            let name = main.to_string_lossy().into_owned();
            Files::from([(name, door::read_program(&root, &main)?)])
        } else {
            door.files(except)?
        };
        let file = match &plugin.kind {
            PluginKind::Cargo(_) => main.join("Cargo.toml"),
            _ => main.clone(),
        };
        ensure!(
            file.to_str().is_some_and(|file| files.contains_key(file)),
            "{} is not part of a submission, like names that start with a dot, and build output; move it",
            root.join(&file).display()
        );
        Ok(Self { plugin, own: Some(OwnFiles { files, root, main }) })
    }

    /// Returns the SHA-256 over the plugin's files.
    pub(crate) fn sha256(&self) -> Result<String> {
        match &self.own {
            Some(own) => Ok(keys::files_sha256(&own.files)),
            None => keys::program_file_sha256(&self.plugin.watched()),
        }
    }

    /// Checks a script, or builds a Cargo project with output in `build`, if given.
    ///
    /// # Errors
    /// If the script is invalid, or the build fails.
    pub(crate) fn check(self, limits: &PluginLimits, build: Option<&Path>) -> Result<GradedPlugin> {
        let Some(mut own) = self.own else {
            let command = self.plugin.command(limits)?;
            return Ok(GradedPlugin { own: None, command, limits: limits.clone() });
        };
        let limits = PluginLimits { untrusted: vec![own.root.clone()], ..limits.clone() };
        let mut command = Vec::new();
        match &self.plugin.kind {
            PluginKind::Script(_) => {
                let script = own.root.join(&own.main);
                let python = python_of(&script)?;
                let (folder, copy) = own.copy()?;
                check_python(&python, &script, &copy.join(&own.main), &limits)?;
                drop(folder);
                // Unbuffered, so that printed lines appear immediately, not after 8 kB.
                command = vec![python.into(), "-u".into()];
            }
            PluginKind::Cargo(_) => own.build(&limits, build)?,
            PluginKind::Program(_) | PluginKind::BuiltIn => {}
        }
        Ok(GradedPlugin { own: Some(own), command, limits })
    }
}

impl OwnFiles {
    /// Writes the files into a new folder; other users of the computer cannot enter it.
    fn copy(&self) -> Result<(TempDir, PathBuf)> {
        let folder = door::private_folder()?;
        let name = self.root.file_name().unwrap_or(OsStr::new("plugin"));
        let copy = folder.path().canonicalize()?.join(name);
        door::write(&self.files, &copy)?;
        Ok((folder, copy))
    }

    /// Builds a Cargo project in a copy. Its program joins the files.
    fn build(&mut self, limits: &PluginLimits, build: Option<&Path>) -> Result<()> {
        let (_folder, copy) = self.copy()?;
        let made = door::private_folder()?;
        let outer = build.unwrap_or(made.path()).canonicalize()?;
        // The build's user may enter this folder, but not the one around it.
        let target = outer.join("build");
        drop(Door::open(&outer)?.make(Path::new("build"))?);
        let project = cargo::ProjectCopy { root: &copy, target: &target };
        let program = cargo::build(&copy.join(&self.main), Some(&project), limits);
        let program = program.with_context(|| match outer_workspace(&self.root) {
            Some(outer) => format!(
                "{} belongs to the workspace {}, which is not copied; grade that folder, with \
                 plugin = \"{}/Cargo.toml\" in its vizflyt.toml",
                self.root.display(),
                outer.display(),
                self.root.strip_prefix(outer).unwrap_or(&self.root).display()
            ),
            None => format!("{}", self.root.display()),
        })?;
        let folder = program.parent().unwrap_or(&target);
        let name = program.file_name().unwrap_or_default();
        let mut left = door::MOST_BYTES;
        let mut read = |name: &OsStr| -> Result<()> {
            let inner = program.with_file_name(name);
            let inner = inner.strip_prefix(&target).context("the build's folder")?;
            let content = door::read_program(&target, inner)?;
            left = left.checked_sub(content.len() as u64).context(
                "its program and libraries are too large; build them without debug information",
            )?;
            let path = self.main.join(BUILT).join(name);
            self.files.insert(path.to_string_lossy().into_owned(), content);
            Ok(())
        };
        read(name)?;
        // Shared libraries that a dependency has put next to the program.
        for entry in folder.read_dir()?.flatten() {
            let library = entry.file_name();
            let is_library = library.to_string_lossy().split('.').any(|part| part == "so");
            if is_library && entry.file_type().is_ok_and(|kind| kind.is_file()) {
                read(&library)?;
            }
        }
        self.main = self.main.join(BUILT).join(name);
        Ok(())
    }
}

impl GradedPlugin {
    /// Makes a copy for one flight.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn copy(&self) -> Result<FlightCopy> {
        let (mut command, mut limits) = (self.command.clone(), self.limits.clone());
        let Some(own) = &self.own else {
            return Ok(FlightCopy { command, limits, _folder: None });
        };
        let (folder, copy) = own.copy()?;
        let main = copy.join(&own.main);
        if main.extension() != Some(OsStr::new("py")) {
            // A script starts in its own folder.
            limits.folder = Some(copy.clone());
        }
        command.push(main.into());
        limits.read.push(copy);
        Ok(FlightCopy { command, limits, _folder: Some(folder) })
    }
}

/// Returns the folder of the Cargo workspace around a folder, if there is one.
fn outer_workspace(root: &Path) -> Option<&Path> {
    let is_workspace = |folder: &&Path| {
        let manifest = std::fs::read_to_string(folder.join("Cargo.toml")).unwrap_or_default();
        manifest.lines().any(|line| line.trim() == "[workspace]")
    };
    root.ancestors().skip(1).find(is_workspace)
}

/// Whether files next to the plugin do not belong to it: in a home folder, and in the output of a build.
fn is_alone(root: &Path, is_program: bool) -> bool {
    let is_home = std::env::home_dir().is_some_and(|home| home.starts_with(root));
    let is_build = |folder: &Path| folder.join(".fingerprint").is_dir();
    is_home || is_program && root.ancestors().take(2).any(is_build)
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::os::unix::fs::{MetadataExt, symlink};

    use super::*;

    fn graded(folder: &Path) -> Result<GradedPlugin> {
        let plugin = Plugin::find(folder.as_os_str())?;
        let limits = PluginLimits { graded: true, ..PluginLimits::default() };
        Submission::read(&plugin, &[])?.check(&limits, None)
    }

    #[test]
    fn gives_each_flight_a_new_copy() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("go"), "#!/bin/sh\n").unwrap();
        fs::write(folder.path().join("vizflyt.toml"), "plugin = \"go\"\n").unwrap();
        let set = |mode| std::os::unix::fs::PermissionsExt::from_mode(mode);
        fs::set_permissions(folder.path().join("go"), set(0o755)).unwrap();
        let plugin = graded(folder.path()).unwrap();
        let copies = [plugin.copy().unwrap(), plugin.copy().unwrap()];
        let of = |copy: &FlightCopy| fs::metadata(copy.command.last().unwrap()).unwrap();
        let [first, second] = copies.each_ref().map(of);
        assert_ne!(first.ino(), second.ino());
        assert_eq!(first.mode() & 0o777, 0o755);
        let outer = Path::new(copies[0].command.last().unwrap()).ancestors().nth(2).unwrap();
        assert_eq!(fs::metadata(outer).unwrap().mode() & 0o777, 0o700);
        let path = copies.map(|copy| PathBuf::from(copy.command.last().unwrap()));
        assert!(path.iter().all(|path| !path.exists()), "removed after the flight");
    }

    #[test]
    fn rejects_links_and_files_that_are_not_submitted() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let refused = |part: &str| {
            let error = format!("{:#}", graded(folder.path()).err().unwrap());
            assert!(error.contains(part), "{part:?} is missing in {error}");
        };
        fs::write(path("plugin.py"), "import vizflyt\n").unwrap();
        symlink("/etc/hostname", path("name")).unwrap();
        refused("name is a link or not a regular file");
        fs::remove_file(path("name")).unwrap();
        symlink("/usr", path(".venv")).unwrap();
        refused(".venv is a link or not a regular file");
        fs::remove_file(path(".venv")).unwrap();
        fs::create_dir_all(path(".venv/bin")).unwrap();
        symlink("/usr/bin/env", path(".venv/bin/python3")).unwrap();
        refused("is not a Python");
        fs::create_dir(path("target")).unwrap();
        fs::write(path("target/plugin.py"), "").unwrap();
        fs::write(path("vizflyt.toml"), "plugin = \"target/plugin.py\"\n").unwrap();
        refused("is not part of a submission");
        fs::remove_file(path("vizflyt.toml")).unwrap();
        symlink("/etc/hostname", path("vizflyt.toml")).unwrap();
        refused("vizflyt.toml is a link");
    }
}
