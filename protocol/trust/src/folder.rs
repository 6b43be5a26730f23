//! Keys folder: accessible only to its owner, with files that are written completely or not at all.

use std::fs::{self, DirBuilder, File, OpenOptions};
use std::io::{self, Read, Write};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::process;
use std::sync::atomic::{AtomicU32, Ordering};

/// Reason why keys cannot be used. Existing files are never replaced silently.
#[derive(Debug, thiserror::Error)]
pub enum KeyError {
    /// Neither `--keys` nor a home folder is set.
    #[error("no folder for keys: neither XDG_CONFIG_HOME nor HOME is set; pass --keys DIR")]
    NoHome,
    /// Reading or writing failed.
    #[error("{}: cannot {what}: {cause}", path.display())]
    Io {
        /// Attempted operation.
        what: &'static str,
        /// File or folder.
        path: PathBuf,
        /// Error of the system.
        cause: io::Error,
    },
    /// Other users may read or write the file or folder.
    #[error("{} is open to other users (mode {mode:03o}); run `chmod {fix} {}`, and make a new key if others had access", path.display(), path.display())]
    Open {
        /// File or folder.
        path: PathBuf,
        /// Current mode.
        mode: u32,
        /// Required mode.
        fix: &'static str,
    },
    /// The content of the file is invalid.
    #[error("{}: {what}", path.display())]
    Damaged {
        path: PathBuf,
        /// Description of the error, with a remedy.
        what: String,
    },
}

/// Folder of keys and of lists of paired peers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct KeysFolder(PathBuf);

/// State of a file: its inode, change time and size.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct FileStamp([i128; 4]);

impl KeysFolder {
    /// Opens `path`, or the user's folder (`$XDG_CONFIG_HOME/vizflyt`, `~/.config/vizflyt`). Creates the folder if it
    /// does not exist.
    pub fn open(path: Option<&Path>) -> Result<Self, KeyError> {
        let path = match path {
            Some(path) => path.to_owned(),
            None => user_folder(
                std::env::var_os("XDG_CONFIG_HOME").map(PathBuf::from),
                std::env::var_os("HOME").map(PathBuf::from),
            )
            .ok_or(KeyError::NoHome)?,
        };
        let io = |what, cause| KeyError::Io { what, path: path.clone(), cause };
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(&path)
            .map_err(|error| io("make the folder for keys", error))?;
        let mode = fs::metadata(&path).map_err(|error| io("look at it", error))?.mode() & 0o777;
        if mode & 0o077 != 0 {
            return Err(KeyError::Open { path, mode, fix: "700" });
        }
        Ok(Self(path))
    }

    /// Returns a folder that other users may enter, for files that are protected by their own mode.
    pub(crate) fn shared(path: &Path) -> Self {
        Self(path.to_owned())
    }

    /// Returns the path of a file in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }

    /// Reads a file that no other user may write; `None` if it does not exist.
    pub fn read(&self, name: &str) -> Result<Option<String>, KeyError> {
        self.read_as(name, 0o022)
    }

    /// Reads a file that no other user may read or write; `None` if it does not exist.
    pub fn read_secret(&self, name: &str) -> Result<Option<String>, KeyError> {
        self.read_as(name, 0o077)
    }

    /// Returns the state of a file, to detect changes; `None` if it does not exist.
    pub fn stamp(&self, name: &str) -> Option<FileStamp> {
        let about = fs::metadata(self.file(name)).ok()?;
        Some(FileStamp([
            about.ino() as i128,
            i128::from(about.ctime()),
            i128::from(about.ctime_nsec()),
            i128::from(about.size()),
        ]))
    }

    fn read_as(&self, name: &str, forbidden: u32) -> Result<Option<String>, KeyError> {
        let path = self.file(name);
        let io = |what, cause| KeyError::Io { what, path: path.clone(), cause };
        // Check first: opening a pipe blocks until a process writes to it.
        match fs::metadata(&path) {
            Ok(about) if about.is_file() => {}
            Ok(_) => {
                let what = "it is not a file; move it away".to_owned();
                return Err(KeyError::Damaged { path, what });
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(io("open it", error)),
        }
        let file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(io("open it", error)),
        };
        let about = file.metadata().map_err(|error| io("look at it", error))?;
        let mode = about.mode() & 0o777;
        if mode & forbidden != 0 {
            return Err(KeyError::Open { path, mode, fix: "600" });
        }
        let mut text = String::new();
        file.take(MAX_BYTES + 1).read_to_string(&mut text).map_err(|error| io("read it", error))?;
        if text.len() as u64 > MAX_BYTES {
            let what = format!("more than {MAX_BYTES} bytes; VizFlyt did not write this file");
            return Err(KeyError::Damaged { path, what });
        }
        Ok(Some(text))
    }

    /// Creates or replaces a file atomically: readers see the old or the new text, never a part.
    pub fn write(&self, name: &str, text: &str) -> Result<(), KeyError> {
        let draft = self.draft(name, text)?;
        let path = self.file(name);
        let moved = fs::rename(&draft, &path);
        self.settle(path, &draft, moved)
    }

    /// Creates a file; returns false if it already exists.
    pub fn create(&self, name: &str, text: &str) -> Result<bool, KeyError> {
        let draft = self.draft(name, text)?;
        let path = self.file(name);
        match fs::hard_link(&draft, &path) {
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {
                let _ = fs::remove_file(&draft);
                Ok(false)
            }
            linked => self.settle(path, &draft, linked).map(|()| true),
        }
    }

    /// Writes the text to a temporary file in the same folder.
    fn draft(&self, name: &str, text: &str) -> Result<PathBuf, KeyError> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let path = self.file(&format!(".{name}.{}.{count}", process::id()));
        let write = || {
            let mut file = OpenOptions::new()
                .write(true)
                .create(true)
                .truncate(true)
                .mode(0o600)
                .open(&path)?;
            // Why: a file left by a crash keeps its own mode.
            file.set_permissions(fs::Permissions::from_mode(0o600))?;
            file.write_all(text.as_bytes())?;
            file.sync_all()
        };
        match write() {
            Ok(()) => Ok(path),
            Err(cause) => {
                let _ = fs::remove_file(&path);
                Err(KeyError::Io { what: "write it", path, cause })
            }
        }
    }

    fn settle(&self, path: PathBuf, draft: &Path, done: io::Result<()>) -> Result<(), KeyError> {
        let _ = fs::remove_file(draft);
        // Sync the folder, so that the name survives a power failure, too.
        done.and_then(|()| File::open(&self.0)?.sync_all()).map_err(|cause| KeyError::Io {
            what: "write it",
            path,
            cause,
        })
    }
}

fn user_folder(config: Option<PathBuf>, home: Option<PathBuf>) -> Option<PathBuf> {
    // A relative XDG_CONFIG_HOME must be ignored (XDG Base Directory Specification).
    let config = config.filter(|path| path.is_absolute());
    let config = config
        .or_else(|| home.filter(|path| path.is_absolute()).map(|path| path.join(".config")))?;
    Some(config.join("vizflyt"))
}

/// Maximum file size. VizFlyt's files are much smaller. [bytes]
const MAX_BYTES: u64 = 1 << 20;

#[cfg(test)]
mod tests {
    use super::*;

    fn mode(path: &Path) -> u32 {
        fs::metadata(path).unwrap().mode() & 0o777
    }

    #[test]
    fn only_the_owner_can_access_the_folder_and_its_files() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("a/keys");
        let folder = KeysFolder::open(Some(&path)).unwrap();
        assert_eq!(folder.read("x").unwrap(), None);
        folder.write("x", "one").unwrap();
        folder.write("x", "two").unwrap();
        assert!(!folder.create("x", "three").unwrap());
        assert!(folder.create("y", "four").unwrap());
        assert_eq!(folder.read("x").unwrap().as_deref(), Some("two"));
        assert_eq!(
            (mode(&path), mode(&path.join("x")), mode(&path.join("y"))),
            (0o700, 0o600, 0o600)
        );
        let mut names: Vec<_> =
            fs::read_dir(&path).unwrap().map(|entry| entry.unwrap().file_name()).collect();
        names.sort();
        assert_eq!(names, ["x", "y"], "no temporary file remains");
    }

    #[test]
    fn rejects_loose_permissions_with_advice() {
        let root = tempfile::tempdir().unwrap();
        let path = root.path().join("keys");
        let folder = KeysFolder::open(Some(&path)).unwrap();
        folder.write("x", "one").unwrap();
        fs::set_permissions(path.join("x"), fs::Permissions::from_mode(0o640)).unwrap();
        assert!(
            folder.read("x").is_ok(),
            "readable by others is accepted for files without secrets"
        );
        let error = folder.read_secret("x").unwrap_err().to_string();
        assert!(error.contains("mode 640") && error.contains("chmod 600 "), "{error}");
        fs::set_permissions(path.join("x"), fs::Permissions::from_mode(0o620)).unwrap();
        assert!(folder.read("x").unwrap_err().to_string().contains("mode 620"));
        fs::set_permissions(&path, fs::Permissions::from_mode(0o755)).unwrap();
        let error = KeysFolder::open(Some(&path)).unwrap_err().to_string();
        assert!(error.contains("mode 755") && error.contains("chmod 700 "), "{error}");
    }

    #[test]
    fn rejects_folders_and_pipes_without_blocking() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        fs::create_dir(folder.file("folder")).unwrap();
        let made = process::Command::new("mkfifo").arg(folder.file("pipe")).status().unwrap();
        assert!(made.success());
        for name in ["folder", "pipe"] {
            let error = folder.read_secret(name).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("it is not a file"), "{error}");
        }
    }

    #[test]
    fn the_users_folder_follows_the_specification() {
        let at = |config: Option<&str>, home: Option<&str>| {
            user_folder(config.map(PathBuf::from), home.map(PathBuf::from))
        };
        assert_eq!(at(Some("/c"), Some("/h")), Some("/c/vizflyt".into()));
        assert_eq!(at(Some("c"), Some("/h")), Some("/h/.config/vizflyt".into()));
        assert_eq!(at(None, Some("/h")), Some("/h/.config/vizflyt".into()));
        assert_eq!(at(None, None), None);
    }
}
