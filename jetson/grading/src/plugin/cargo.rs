//! Builds a plugin that is a Cargo project. Its build scripts and macros run in the sandbox.
//!
//! ```text
//! cargo metadata   run in the root folder, so that the project's settings do not apply; fetches dependencies
//! cargo build      in the sandbox, without network; for a grade also in the root folder
//! ```

use std::ffi::OsString;
use std::os::unix::fs::fchown;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;
use std::{env, fs};

use anyhow::{Context, Result, anyhow, bail, ensure};
use serde::Deserialize;
use serde_json::Value;
use vizflyt_process::print_error;
use vizflyt_runtime::console::printable;
use vizflyt_runtime::supervisor::{Confinement, PluginLimits};

use super::sources;
use crate::door::Door;

/// Description of a project by Cargo.
#[derive(Deserialize)]
struct Metadata {
    packages: Vec<Package>,
    workspace_root: PathBuf,
    target_directory: PathBuf,
}

#[derive(Deserialize)]
struct Package {
    name: String,
    /// Source of the package; `None` for a folder on this computer.
    source: Option<String>,
    manifest_path: PathBuf,
}

/// Timeout of a build: enough for a large library on a slow computer.
const BUILD_WITHIN: Duration = Duration::from_mins(30);
/// Maximum number of processes: the build starts a compiler per processor, with several threads
/// each.
const BUILD_PROCESSES: u32 = 4096;

/// Copy of a graded project.
pub(super) struct ProjectCopy<'a> {
    /// Folder of the submission, which must contain the project's workspace.
    pub root: &'a Path,
    /// Folder of the grader for the build's output.
    pub target: &'a Path,
}

/// Builds a Cargo project and returns its program. Cargo's messages go to standard error. Without a `copy`, the output
/// goes into the project's own folder.
///
/// # Errors
/// If the build fails, or if the project has no or several programs. For a grade, also if packages
/// come from another folder on this computer.
pub(super) fn build(
    folder: &Path,
    copy: Option<&ProjectCopy<'_>>,
    limits: &PluginLimits,
) -> Result<PathBuf> {
    let folder = if folder == Path::new("") { Path::new(".") } else { folder };
    let folder = folder.canonicalize().with_context(|| format!("{}", folder.display()))?;
    let metadata = metadata(&folder)?;
    let own = &metadata.workspace_root;
    let mut read = metadata.elsewhere(limits.graded)?;
    read.push(own.clone());
    read.extend(toolchain());
    ensure!(
        copy.is_none_or(|copy| own.starts_with(copy.root)),
        "its workspace is {}, outside its folder: a graded plugin must contain its workspace",
        own.display()
    );
    let target = copy.map_or_else(|| metadata.own_target(), |copy| Ok(copy.target.to_owned()))?;
    let limits = PluginLimits {
        processes: BUILD_PROCESSES,
        network: false,
        read,
        write: vec![target.clone()],
        untrusted: vec![own.clone()],
        // Cargo takes settings and toolchain from the folder in which it starts, and from those around it.
        folder: Some(if limits.graded { "/".into() } else { folder.clone() }),
        graded: limits.graded,
        hide: limits.hide.clone(),
        user: limits.user.clone(),
        ..PluginLimits::default()
    };
    let confinement = Confinement::prepare(&limits, &[OsString::from("cargo")]);
    let target = match confinement.user_id() {
        // Root made the folder, but another user builds.
        Some(user) => {
            let own = Door::open(&target)?.make(Path::new("confined"))?;
            fchown(own, Some(user), None).context("cannot hand the build its folder")?;
            target.join("confined")
        }
        None => target,
    };
    let mut cargo = confinement.command("cargo");
    cargo
        .args(["build", "--release", "--offline", "--message-format=json-render-diagnostics"])
        .arg("--manifest-path")
        .arg(folder.join("Cargo.toml"))
        .arg("--target-dir")
        .arg(&target)
        // The wrapper needs a server process, which is not in the sandbox.
        .env("RUSTC_WRAPPER", "")
        .env("CARGO_HOME", home_of("CARGO_HOME", ".cargo"))
        .env("RUSTUP_HOME", home_of("RUSTUP_HOME", ".rustup"))
        .current_dir(&folder)
        .stdout(Stdio::piped());
    if limits.graded {
        // Student code must not hold the grader's terminal: it could read what is typed there.
        cargo.stderr(Stdio::piped());
    }
    let output = confinement
        .run(cargo, BUILD_WITHIN)
        .with_context(|| format!("{} cannot be built", folder.display()))?;
    for line in String::from_utf8_lossy(&output.stderr).lines() {
        print_error(printable(line));
    }
    if !output.status.success() {
        bail!("{} does not build; see the compiler's message above", folder.display());
    }
    let programs = programs(&String::from_utf8_lossy(&output.stdout));
    match programs.as_slice() {
        // The output of the build is untrusted student code.
        [program] => {
            let inner = program.strip_prefix(&target).map_err(|_| {
                anyhow!(
                    "{} builds {}, outside its target folder",
                    folder.display(),
                    program.display()
                )
            })?;
            Door::open(&target)?.file(inner)?;
            Ok(program.clone())
        }
        [] => bail!("{} builds no program; a plugin has a src/main.rs", folder.display()),
        several => bail!(
            "{} builds {} programs; fly one of them by its path, such as {}",
            folder.display(),
            several.len(),
            several[0].display()
        ),
    }
}

/// Runs `cargo metadata`, which fetches dependencies. No code of the project runs: its settings and
/// toolchain file apply only in its own folder, and this runs in another one.
fn metadata(folder: &Path) -> Result<Metadata> {
    let mut cargo = Command::new("cargo");
    cargo.args(["metadata", "--format-version=1", "--quiet", "--manifest-path"]);
    cargo.arg(folder.join("Cargo.toml")).current_dir("/").stdin(Stdio::null());
    // Cargo would write a cache into the project's `target`, which may be a link.
    cargo.env("CARGO_CACHE_RUSTC_INFO", "0");
    // A dependency must not be fetched with the keys of the grader.
    cargo.env_remove("SSH_AUTH_SOCK");
    let output = cargo.stderr(Stdio::inherit()).output().with_context(|| {
        format!("cannot start cargo to build {}; rustup.rs installs it", folder.display())
    })?;
    ensure!(
        output.status.success(),
        "{} does not build; see cargo's message above",
        folder.display()
    );
    serde_json::from_slice(&output.stdout).context("cargo's description of the project")
}

impl Metadata {
    /// Makes the project's folder for output.
    ///
    /// # Errors
    /// If it is a link: the build could write where the link leads. A folder outside the project is the user's choice.
    fn own_target(&self) -> Result<PathBuf> {
        let target = &self.target_directory;
        if let Ok(inner) = target.strip_prefix(&self.workspace_root) {
            let made = Door::open(&self.workspace_root)?.make(inner);
            drop(made.with_context(|| {
                format!(
                    "cannot build in {}; remove it, or name another folder in CARGO_TARGET_DIR",
                    target.display()
                )
            })?);
        } else {
            fs::create_dir_all(target)
                .with_context(|| format!("cannot make {}", target.display()))?;
        }
        Ok(target.clone())
    }

    /// Returns the folders of packages outside the project.
    ///
    /// # Errors
    /// If the plugin is graded, and the packages are not VizFlyt's own.
    fn elsewhere(&self, graded: bool) -> Result<Vec<PathBuf>> {
        let ours = sources().ok();
        let mut folders = Vec::new();
        for package in &self.packages {
            let folder = package.manifest_path.parent().unwrap_or(Path::new("/"));
            // A branch may change after the submission, and a repository may contain others of this computer.
            let is_registry = |from: &String| {
                from.starts_with("registry+https:") || from.starts_with("sparse+https:")
            };
            let is_cloned = package.source.as_ref().is_some_and(|from| !is_registry(from));
            let is_here = package.source.is_none() && !folder.starts_with(&self.workspace_root);
            let is_ours = ours.as_ref().is_some_and(|ours| folder.starts_with(ours));
            ensure!(
                !graded || is_ours || !(is_cloned || is_here),
                "its package {} is outside its folder, at {}: a graded plugin must contain its \
                 packages, or use a registry",
                package.name,
                package.source.clone().unwrap_or_else(|| folder.display().to_string())
            );
            folders.extend(is_here.then(|| folder.to_owned()));
        }
        // A package inherits from the manifest of its workspace.
        folders.extend(ours.filter(|ours| folders.iter().any(|folder| folder.starts_with(ours))));
        Ok(folders)
    }
}

/// Returns the paths that Cargo reads in addition to the project: compilers and packages, without
/// credentials.
fn toolchain() -> Vec<PathBuf> {
    let cargo = home_of("CARGO_HOME", ".cargo");
    let parts = ["bin", "registry", "git", "config.toml", "config"].map(|name| cargo.join(name));
    parts.into_iter().chain([home_of("RUSTUP_HOME", ".rustup")]).collect()
}

fn home_of(variable: &str, folder: &str) -> PathBuf {
    let given = env::var_os(variable).map(PathBuf::from);
    given.unwrap_or_else(|| env::home_dir().unwrap_or_default().join(folder))
}

/// Returns the programs listed in Cargo's messages.
fn programs(messages: &str) -> Vec<PathBuf> {
    let artifact = |line: &str| {
        let message: Value = serde_json::from_str(line).ok()?;
        let is_program = message["target"]["kind"].as_array()?.contains(&Value::from("bin"));
        message["executable"].as_str().filter(|_| is_program).map(PathBuf::from)
    };
    messages.lines().filter_map(artifact).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_programs_in_cargos_messages() {
        let text = "noise\n{\"reason\":\"compiler-artifact\",\"target\":{\"kind\":[\"lib\"]}}\n\
            {\"reason\":\"compiler-artifact\",\"target\":{\"kind\":[\"custom-build\"]},\"executable\":\"/b\"}\n\
            {\"reason\":\"compiler-artifact\",\"target\":{\"kind\":[\"bin\"]},\"executable\":\"/t/first\"}\n\
            {\"reason\":\"build-finished\",\"success\":true}\n";
        assert_eq!(programs(text), [PathBuf::from("/t/first")]);
        assert!(programs("").is_empty());
    }

    #[test]
    fn rejects_packages_outside_a_graded_plugin() {
        let package = |source: Option<&str>, manifest: &str| Package {
            name: "help".into(),
            source: source.map(str::to_owned),
            manifest_path: manifest.into(),
        };
        let of = |package| Metadata {
            packages: vec![package],
            workspace_root: "/submission".into(),
            target_directory: "/submission/target".into(),
        };
        let registry = "registry+https://github.com/rust-lang/crates.io-index";
        for good in [
            package(None, "/submission/Cargo.toml"),
            package(None, "/submission/parts/help/Cargo.toml"),
            package(Some(registry), "/home/x/.cargo/registry/src/help/Cargo.toml"),
        ] {
            assert!(of(good).elsewhere(true).unwrap().is_empty());
        }
        let solution = || package(None, "/home/x/solution/Cargo.toml");
        let cloned = package(Some("git+file:///home/x/solution"), "/home/x/.cargo/git/Cargo.toml");
        let branch = package(
            Some("git+https://example.org/solution?branch=main"),
            "/home/x/.cargo/git/checkouts/help/Cargo.toml",
        );
        for bad in [solution(), cloned, branch] {
            let error = of(bad).elsewhere(true).unwrap_err().to_string();
            assert!(
                error.contains("is outside its folder") && error.contains("solution"),
                "{error}"
            );
        }
        let folders = of(solution()).elsewhere(false).unwrap();
        assert_eq!(folders, [PathBuf::from("/home/x/solution")], "not graded");
    }
}
