//! `--watch`: watches a plugin's files and restarts the plugin after a change. A Cargo project is
//! built first, and a script checked, while the old plugin keeps flying. If that fails, the old
//! plugin stays.

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Receiver, channel};
use std::thread;
use std::time::{Duration, SystemTime};

use anyhow::{Context, Result};
use vizflyt_process::print_error;
use vizflyt_runtime::supervisor::PluginLimits;

use super::Plugin;

/// Period of checks: shorter than the user notices, and cheap for a folder of sources.
pub const LOOK_EVERY: Duration = Duration::from_millis(250);
/// Maximum depth of folders.
const DEEPEST: usize = 8;

/// Starts to watch. The receiver gets a message each time the plugin must be restarted.
///
/// # Errors
/// If the thread cannot be started.
pub fn watch(plugin: Plugin, limits: PluginLimits) -> Result<Receiver<()>> {
    let (sender, receiver) = channel();
    let look = move || {
        let mut known = Sources::of(&plugin.watched());
        loop {
            thread::sleep(LOOK_EVERY);
            let found = Sources::of(&plugin.watched());
            // An editor or linker may still be writing: two checks must agree. A missing file is
            // about to be written again.
            if found == known || found.0.is_empty() {
                continue;
            }
            thread::sleep(LOOK_EVERY);
            if Sources::of(&plugin.watched()) != found {
                continue;
            }
            known = found;
            match plugin.command(&limits) {
                Ok(_) if sender.send(()).is_err() => return,
                Ok(_) => {}
                Err(error) => print_error(format_args!("not reloaded: {error:#}")),
            }
        }
    };
    thread::Builder::new().name("watch".into()).spawn(look).context("cannot watch the plugin")?;
    Ok(receiver)
}

/// Files with time and size of their last change.
#[derive(Debug, PartialEq, Eq)]
pub struct Sources(BTreeMap<PathBuf, (SystemTime, u64)>);

impl Sources {
    /// Reads the state of a file, or of the sources in a folder.
    pub fn of(path: &Path) -> Self {
        let mut sources = Self(BTreeMap::new());
        if path.is_dir() {
            sources.add_folder(path, 0);
        } else {
            sources.add(path.to_owned());
        }
        sources
    }

    fn add(&mut self, path: PathBuf) {
        if let Ok(data) = path.metadata()
            && let Ok(changed) = data.modified()
        {
            self.0.insert(path, (changed, data.len()));
        }
    }

    fn add_folder(&mut self, folder: &Path, depth: usize) {
        let Ok(entries) = std::fs::read_dir(folder) else { return };
        for entry in entries.filter_map(std::result::Result::ok) {
            let path = entry.path();
            let name = entry.file_name().to_string_lossy().into_owned();
            // Links are not followed: they may point to a parent folder.
            let Ok(kind) = entry.file_type() else { continue };
            if kind.is_dir() && depth < DEEPEST {
                let is_made = matches!(name.as_str(), "target" | "flights" | "__pycache__");
                if !is_made && !name.starts_with('.') {
                    self.add_folder(&path, depth + 1);
                }
            } else if ["py", "rs", "toml"].map(OsStr::new).map(Some).contains(&path.extension()) {
                self.add(path);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    #[test]
    fn detects_changed_sources_and_ignores_build_output() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = folder.path().join(name);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, text).unwrap();
        };
        write("src/main.rs", "1");
        let first = Sources::of(folder.path());
        assert_eq!(first.0.len(), 1);
        write("target/release/build.rs", "");
        write(".venv/lib/numpy.py", "");
        write("__pycache__/plugin.py", "");
        write("report.json", "");
        assert_eq!(Sources::of(folder.path()), first);
        write("src/main.rs", "12");
        let second = Sources::of(folder.path());
        assert_ne!(second, first);
        write("src/more.rs", "");
        assert_ne!(Sources::of(folder.path()), second);
        let file = folder.path().join("src/main.rs");
        assert_eq!(Sources::of(&file).0.len(), 1);
        fs::remove_file(&file).unwrap();
        assert!(Sources::of(&file).0.is_empty());
    }
}
