//! Plugins: resolves the argument PLUGIN, and returns the command that starts it.
//!
//! ```text
//! avoid                 a built-in plugin: this program, as `vizflyt plugin avoid`
//! first/                folder with vizflyt.toml (made by `vizflyt new`); or a Cargo project; or plugin.py
//! first/plugin.py       run by python3 of its .venv, or of this program's environment, or in PATH
//! target/release/first  a program; a name without / is searched in PATH
//! ```

pub mod built_in;
mod cargo;
pub mod manifest;
pub(crate) mod submission;
pub mod watch;

use std::ffi::{OsStr, OsString};
use std::fs;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use vizflyt_runtime::console::printable;
use vizflyt_runtime::supervisor::{Confinement, PluginLimits, is_python};

use self::built_in::BuiltIn;
use self::manifest::{LabConfig, PluginManifest};
use crate::door::Door;

/// A plugin that exists.
#[derive(Clone, Debug, PartialEq)]
pub struct Plugin {
    name: OsString,
    kind: PluginKind,
    lab: Option<LabConfig>,
}

#[derive(Clone, Debug, PartialEq)]
enum PluginKind {
    BuiltIn,
    /// Python file.
    Script(PathBuf),
    /// Folder of a Cargo.toml.
    Cargo(PathBuf),
    /// Program: a path, or a name that is searched in PATH.
    Program(PathBuf),
}

impl Plugin {
    /// Determines the kind of plugin `name`. Starts and builds nothing.
    ///
    /// # Errors
    /// If it is not a plugin.
    pub fn find(name: &OsStr) -> Result<Self> {
        let found = |kind, lab| Ok(Self { name: name.to_owned(), kind, lab });
        let path = Path::new(name);
        let is_bare = path.components().count() == 1 && !name.to_string_lossy().contains('/');
        if is_bare && BuiltIn::find(&name.to_string_lossy()).is_some() {
            return found(PluginKind::BuiltIn, None);
        }
        if path.is_dir() {
            if let Some(manifest) = PluginManifest::read(path)? {
                return found(kind_of(&manifest.plugin)?, Some(manifest.lab));
            }
            for file in ["Cargo.toml", "plugin.py"] {
                if path.join(file).is_file() {
                    return found(kind_of(&path.join(file))?, None);
                }
            }
            bail!(
                "{} is a folder without vizflyt.toml, Cargo.toml or plugin.py; `vizflyt new NAME` \
                 makes one that flies",
                path.display()
            );
        }
        if path.is_file() {
            return found(kind_of(path)?, None);
        }
        if is_bare && on_path(name) {
            return found(PluginKind::Program(name.into()), None);
        }
        bail!(
            "there is no plugin at {}; give a folder made by `vizflyt new`, a .py file, a program, \
             or a built-in: {}",
            path.display(),
            BuiltIn::names()
        )
    }

    /// Returns the name of the plugin on the command line.
    pub fn name(&self) -> &OsStr {
        &self.name
    }

    /// Returns the simulated lab of the plugin's manifest.
    pub fn lab(&self) -> Option<&LabConfig> {
        self.lab.as_ref()
    }

    /// Returns the file or folder to watch for changes.
    pub fn watched(&self) -> PathBuf {
        match &self.kind {
            PluginKind::BuiltIn => std::env::current_exe().unwrap_or_default(),
            PluginKind::Program(path) => path.clone(),
            PluginKind::Cargo(folder) => folder.clone(),
            // Imports are in the same folder.
            PluginKind::Script(script) => match script.parent() {
                Some(folder) if folder != Path::new("") => folder.to_owned(),
                _ => PathBuf::from("."),
            },
        }
    }

    /// Returns the command that starts the plugin under `limits`. A script is checked and a Cargo
    /// project is built first, in the same sandbox as in flight: both run student code.
    ///
    /// # Errors
    /// If the build fails, or Python does not find the package `vizflyt`.
    pub fn command(&self, limits: &PluginLimits) -> Result<Vec<OsString>> {
        match &self.kind {
            PluginKind::BuiltIn => {
                let program = std::env::current_exe().context("cannot find this program's path")?;
                Ok(vec![program.into(), "plugin".into(), self.name.clone()])
            }
            // A plugin may start in another folder, so a relative path must be made absolute; a name
            // in PATH stays.
            PluginKind::Program(path) => {
                Ok(vec![if path.is_file() { absolute(path)?.into() } else { path.into() }])
            }
            PluginKind::Cargo(folder) => Ok(vec![cargo::build(folder, None, limits)?.into()]),
            PluginKind::Script(script) => {
                let path = absolute(script)?;
                let python = python_of(&path)?;
                check_python(&python, script, &path, limits)?;
                // Unbuffered, so that printed lines appear immediately, not after 8 kB.
                Ok(vec![python.into(), "-u".into(), path.into()])
            }
        }
    }
}

fn absolute(path: &Path) -> Result<PathBuf> {
    std::path::absolute(path).context("cannot find the working folder")
}

/// Returns the kind of an existing file.
fn kind_of(path: &Path) -> Result<PluginKind> {
    use std::os::unix::fs::PermissionsExt;
    if !path.is_file() {
        bail!("there is no file {}", path.display());
    }
    if path.file_name() == Some(OsStr::new("Cargo.toml")) {
        return Ok(PluginKind::Cargo(path.parent().unwrap_or(Path::new(".")).to_owned()));
    }
    if path.extension() == Some(OsStr::new("py")) {
        return Ok(PluginKind::Script(path.to_owned()));
    }
    let mode = path.metadata().with_context(|| format!("{}", path.display()))?.permissions().mode();
    if mode & 0o111 == 0 {
        bail!("{0} is neither a .py file nor a program; try `chmod +x {0}`", path.display());
    }
    Ok(PluginKind::Program(path.to_owned()))
}

fn on_path(name: &OsStr) -> bool {
    let path = std::env::var_os("PATH").unwrap_or_default();
    std::env::split_paths(&path).any(|folder| folder.join(name).is_file())
}

/// Returns the interpreter of the script's virtual environment, or of the environment that this
/// program was installed into, or the one in PATH.
///
/// # Errors
/// If the environment is a link, or its interpreter leads to anything except a Python.
fn python_of(script: &Path) -> Result<PathBuf> {
    let folder = script.parent().unwrap_or(Path::new(""));
    let own = folder.join(".venv/bin/python3");
    if folder.join(".venv").symlink_metadata().is_err() || !own.exists() {
        return Ok(own_python().unwrap_or_else(|| "python3".into()));
    }
    let advice = || {
        let venv = folder.join(".venv");
        format!("remove {0} and make it with `python3 -m venv {0}`", venv.display())
    };
    let bin = Door::open(folder)?.folder(Path::new(".venv/bin")).with_context(advice)?;
    drop(bin);
    let python = own.canonicalize().with_context(|| format!("cannot read {}", own.display()))?;
    let is_link = own.is_symlink() && !python.starts_with(folder.canonicalize()?);
    if is_link && !is_python(&python) {
        bail!(
            "{} leads to {}, which is not a Python; {}",
            own.display(),
            python.display(),
            advice()
        );
    }
    Ok(own)
}

/// Returns the interpreter next to this program, if `pip install` has installed the program.
pub fn own_python() -> Option<PathBuf> {
    let program = std::env::current_exe().ok()?;
    let python = program.with_file_name("python3");
    let libraries = program.parent()?.parent()?.join("lib").read_dir().ok()?;
    let has_package = |library: PathBuf| library.join("site-packages/vizflyt").is_dir();
    let is_there = libraries.flatten().any(|library| has_package(library.path()));
    (is_there && python.exists()).then_some(python)
}

/// Compiles the script, then imports the package as the script will: Python searches the script's
/// own folder first.
const CHECK: &str = "
import sys
try:
    compile(open(sys.argv[1], 'rb').read(), sys.argv[1], 'exec')
except (SyntaxError, ValueError) as error:
    import traceback
    sys.exit('cannot be compiled\\n' + ''.join(traceback.format_exception_only(error)))
sys.path.insert(0, sys.argv[2])
import vizflyt
vizflyt.run
";

/// Timeout of the check: enough for an import of a large library from a slow disk.
const CHECK_WITHIN: Duration = Duration::from_mins(2);

/// Checks that the plugin is valid Python and finds the package, before other processes are
/// started. `copy` is the checked file; messages name `script`.
fn check_python(python: &Path, script: &Path, copy: &Path, limits: &PluginLimits) -> Result<()> {
    let folder = script.parent().unwrap_or(Path::new(""));
    if folder.join("vizflyt.py").exists() {
        bail!(
            "{} hides the package vizflyt from your plugin; give the file another name",
            folder.join("vizflyt.py").display()
        );
    }
    let own = copy.parent().unwrap_or(Path::new("/"));
    let confinement = Confinement::prepare(limits, &[python.into(), copy.into()]);
    let mut check = confinement.command(python);
    check.args(["-c", CHECK]).args([copy, own]);
    check.stdout(Stdio::null()).stderr(Stdio::piped());
    let output = match confinement.run(check, CHECK_WITHIN) {
        Ok(output) => output,
        Err(error) if error.kind() == io::ErrorKind::TimedOut => {
            bail!("{} cannot be checked: {error}", script.display())
        }
        Err(error) => bail!(
            "{} is written in Python, and {} cannot be started: {error}; on Debian and Ubuntu: \
             sudo apt install python3 python3-venv",
            script.display(),
            python.display()
        ),
    };
    if output.status.success() {
        return Ok(());
    }
    let words: Vec<_> = String::from_utf8_lossy(&output.stderr).lines().map(printable).collect();
    let words = words.join("\n").replace(&*copy.to_string_lossy(), &script.to_string_lossy());
    if let Some(mistake) = words.strip_prefix("cannot be compiled\n") {
        bail!("{} is not Python:\n{}", script.display(), mistake.trim_end());
    }
    let last = words.lines().rfind(|line| !line.trim().is_empty()).unwrap_or("no reason given");
    if let Some(user) = confinement.user_id().filter(|_| last.contains("PermissionError")) {
        bail!(
            "{last}: a plugin that root starts runs as another user (uid {user}), which must be able to read it; \
             `{}` lets everybody, or start vizflyt as an ordinary user",
            open_to_all(folder)
        );
    }
    let venv = folder.join(".venv");
    let package = match sources() {
        Ok(root) => root.join("jetson/python").display().to_string(),
        Err(_) => "vizflyt".to_owned(),
    };
    bail!(
        "{} cannot import the package vizflyt ({last}); install it with `python3 -m venv {venv} && \
         {venv}/bin/pip install {package}`",
        python.display(),
        venv = venv.display(),
    )
}

/// Returns the command after which every user can read `folder`: the folders above it must also let
/// others through.
fn open_to_all(folder: &Path) -> String {
    let is_closed = |above: &&Path| {
        fs::metadata(above).is_ok_and(|found| found.permissions().mode() & 0o001 == 0)
    };
    let mut closed: Vec<_> = folder.ancestors().skip(1).filter(is_closed).collect();
    closed.reverse();
    let mut steps: Vec<_> =
        closed.iter().map(|above| format!("chmod a+x {}", above.display())).collect();
    steps.push(format!("chmod -R a+rX {}", folder.display()));
    steps.join(" && ")
}

/// Returns the folder of this program's sources with the SDK, if it still exists.
pub fn sources() -> Result<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap_or(Path::new("/"));
    if !root.join("jetson/sdk/Cargo.toml").is_file() {
        bail!(
            "the sources that this program was built from are not at {}; clone {} and build the program there",
            root.display(),
            env!("CARGO_PKG_REPOSITORY")
        );
    }
    root.canonicalize().with_context(|| format!("cannot resolve {}", root.display()))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    fn refused(name: &Path, parts: &[&str]) {
        let error = format!("{:#}", Plugin::find(name.as_os_str()).unwrap_err());
        for part in parts {
            assert!(error.contains(part), "{} does not contain {part:?}: {error}", name.display());
        }
    }

    #[test]
    fn distinguishes_plugins() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let kind = |path: &Path| Plugin::find(path.as_os_str()).unwrap().kind;
        assert_eq!(kind(Path::new("avoid")), PluginKind::BuiltIn);
        assert_eq!(kind(Path::new("sh")), PluginKind::Program("sh".into()), "on PATH");
        refused(&path("none"), &["there is no plugin at", "none", "avoid"]);
        refused(Path::new("no-such-program"), &["there is no plugin at no-such-program"]);
        refused(folder.path(), &["folder without", "vizflyt new"]);

        fs::write(path("plugin.py"), "").unwrap();
        assert_eq!(kind(folder.path()), PluginKind::Script(path("plugin.py")));
        assert_eq!(kind(&path("plugin.py")), PluginKind::Script(path("plugin.py")));
        fs::write(path("Cargo.toml"), "").unwrap();
        assert_eq!(kind(folder.path()), PluginKind::Cargo(folder.path().to_owned()));
        fs::write(path("vizflyt.toml"), "plugin = \"plugin.py\"\n[lab]\nscene = \"room\"\n")
            .unwrap();
        let plugin = Plugin::find(folder.path().as_os_str()).unwrap();
        assert_eq!(plugin.kind, PluginKind::Script(path("plugin.py")));
        assert_eq!(plugin.lab().unwrap().scene.as_deref(), Some("room"));

        fs::write(path("notes.txt"), "").unwrap();
        refused(&path("notes.txt"), &["neither", "chmod +x"]);
        // A manifest may name a program: that starts, not the folder's name.
        fs::write(path("go"), "").unwrap();
        fs::set_permissions(path("go"), fs::Permissions::from_mode(0o755)).unwrap();
        fs::write(path("vizflyt.toml"), "plugin = \"go\"\n").unwrap();
        let plugin = Plugin::find(folder.path().as_os_str()).unwrap();
        let command = plugin.command(&PluginLimits::default()).unwrap();
        assert_eq!(command, [path("go").into_os_string()]);
        fs::write(path("vizflyt.toml"), "plugin = \"gone.py\"\n").unwrap();
        refused(folder.path(), &["no file", "gone.py"]);
        fs::write(path("vizflyt.toml"), "plugins = \"gone.py\"\n").unwrap();
        refused(folder.path(), &["vizflyt.toml", "did you mean 'plugin'"]);
    }

    #[test]
    fn uses_the_python_of_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("plugin.py");
        assert_eq!(python_of(&script).unwrap(), Path::new("python3"));
        fs::create_dir_all(folder.path().join(".venv/bin")).unwrap();
        let own = folder.path().join(".venv/bin/python3");
        fs::write(&own, "").unwrap();
        assert_eq!(python_of(&script).unwrap(), own);
    }

    #[test]
    fn names_a_file_that_hides_the_package() {
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("plugin.py");
        fs::write(folder.path().join("vizflyt.py"), "").unwrap();
        let error = check_python(Path::new("python3"), &script, &script, &PluginLimits::default())
            .unwrap_err()
            .to_string();
        assert!(error.contains("vizflyt.py hides the package"), "{error}");
    }

    #[test]
    fn names_the_closed_folder_above_a_plugin() {
        let above = tempfile::tempdir().unwrap();
        let folder = above.path().join("first");
        fs::create_dir(&folder).unwrap();
        for (mode, opens) in [(0o700, true), (0o755, false)] {
            fs::set_permissions(above.path(), fs::Permissions::from_mode(mode)).unwrap();
            let command = open_to_all(&folder);
            let first = format!("chmod a+x {} && ", above.path().display());
            assert_eq!(command.contains(&first), opens, "{command}");
            assert!(command.ends_with(&format!("chmod -R a+rX {}", folder.display())), "{command}");
        }
    }

    #[test]
    fn shows_the_line_of_a_syntax_error() {
        let folder = tempfile::tempdir().unwrap();
        let script = folder.path().join("plugin.py");
        fs::write(&script, "import vizflyt\nclass First(vizflyt.Plugin:\n").unwrap();
        let error = check_python(Path::new("python3"), &script, &script, &PluginLimits::default())
            .unwrap_err()
            .to_string();
        for part in ["plugin.py is not Python", "line 2", "class First", "SyntaxError"] {
            assert!(error.contains(part), "{part:?} is missing in {error}");
        }
    }
}
