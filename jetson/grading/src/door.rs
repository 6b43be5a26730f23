//! Entrance for files of students. Every file is opened beneath its folder, without following links.
//!
//! ```text
//! folder, ZIP archive ──▶ Files, in memory ──▶ a copy for check and build, a new copy for each flight
//! ```
//! Links, devices, pipes and sockets are rejected. Names that no plugin needs (`.git`, `target`) are left out.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, OpenOptionsExt};
use std::path::{Component, Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use rustix::fs::{AtFlags, Dir, FileType, Mode, OFlags, fstat, mkdirat, open, openat, statat};
use rustix::io::Errno;

/// Maximum size of all files together. [bytes]
pub const MOST_BYTES: u64 = 200 << 20;
/// Maximum number of files, and of folders.
pub const MOST_FILES: usize = 5000;
/// Maximum length of a path. [bytes]
const MOST_PATH: usize = 1024;
/// Folders that builds, interpreters and flights make.
const MADE: [&str; 5] = ["target", "__pycache__", "node_modules", "flights", "venv"];

/// Files of a submission by path, with `/`.
pub type Files = BTreeMap<String, Vec<u8>>;

/// Whether a file or folder of this name is not part of a submission.
fn is_left_out(name: &str) -> bool {
    let is_made = Path::new(name).extension().is_some_and(|end| end == "pyc" || end == "mcap");
    name.starts_with('.') || is_made
}

/// Returns a path from an archive in the form of [`Files`]; `None` if a submission does not contain such files.
///
/// # Errors
/// If the path is absolute or leads out of its folder.
pub(crate) fn path_of(name: &str) -> Result<Option<String>> {
    let parts = Path::new(name).components().map(|part| match part {
        Component::Normal(part) => part.to_str(),
        _ => None,
    });
    let parts: Option<Vec<&str>> = parts.collect();
    let parts = parts.filter(|parts| !parts.is_empty() && !name.contains(['\\', '\0']));
    let parts =
        parts.with_context(|| format!("'{}' leads out of the archive", name.escape_debug()))?;
    let folders = &parts[..parts.len() - 1];
    let is_out = parts.iter().any(|part| is_left_out(part))
        || folders.iter().any(|part| MADE.contains(part));
    Ok((!is_out).then(|| parts.join("/")))
}

/// An open folder of a student.
#[derive(Debug)]
pub(crate) struct Door {
    root: OwnedFd,
    path: PathBuf,
}

impl Door {
    /// Opens a folder. Links on the way to it are followed: the path is the grader's.
    pub(crate) fn open(path: &Path) -> Result<Self> {
        let path = if path == Path::new("") { Path::new(".") } else { path };
        let root = open(path, FOLDER - OFlags::NOFOLLOW, Mode::empty());
        let root = root.with_context(|| format!("cannot open the folder {}", path.display()))?;
        Ok(Self { root, path: path.to_owned() })
    }

    /// Reads all files of a submission except those in `except`, such as reports and keys of the grader.
    ///
    /// # Errors
    /// If the folder contains a link, a device, a pipe or a socket, or exceeds a limit.
    pub(crate) fn files(&self, except: &[PathBuf]) -> Result<Files> {
        let except = except.iter().filter_map(|path| fs::metadata(path).ok());
        let except: BTreeSet<(u64, u64)> = except.map(|it| (it.dev(), it.ino())).collect();
        let (mut files, mut left) = (Files::new(), MOST_BYTES);
        let (mut folders, mut opened) = (vec![String::new()], 0);
        while let Some(prefix) = folders.pop() {
            opened += 1;
            let listed = self.list(&prefix)?;
            // A virtual environment of any name.
            if listed.iter().any(|(name, _)| name == "pyvenv.cfg") {
                continue;
            }
            for (name, kind) in listed {
                let path = format!("{prefix}{name}");
                let at = self.path.join(&path);
                if is_left_out(&name) || kind == FileType::Directory && MADE.contains(&&*name) {
                    continue;
                }
                ensure!(
                    path.len() <= MOST_PATH,
                    "{}: the path is too long; shorten it",
                    at.display()
                );
                if kind == FileType::Directory {
                    let found = fstat(self.folder(Path::new(&path))?)?;
                    if !except.contains(&(found.st_dev, found.st_ino)) {
                        folders.push(format!("{path}/"));
                    }
                } else {
                    let file = self.file(Path::new(&path))?;
                    let found =
                        file.metadata().with_context(|| format!("cannot read {}", at.display()))?;
                    if except.contains(&(found.dev(), found.ino())) {
                        continue;
                    }
                    let content = read(file, left)
                        .with_context(|| format!("cannot read {}", at.display()))?;
                    let rest = left.checked_sub(content.len() as u64);
                    left = rest.with_context(|| self.too_many(&format!("{MOST_BYTES} bytes")))?;
                    files.insert(path, content);
                }
                let count = files.len().max(folders.len() + opened);
                ensure!(
                    count <= MOST_FILES,
                    self.too_many(&format!("{MOST_FILES} files or folders"))
                );
            }
        }
        Ok(files)
    }

    /// Opens a regular file beneath the folder for reading.
    ///
    /// # Errors
    /// If the path leads out of the folder, or any part of it is a link.
    pub(crate) fn file(&self, path: &Path) -> Result<File> {
        let at = self.path.join(path);
        let name = path.file_name().with_context(|| self.leads_out(path))?;
        let folder = self.folder(path.parent().unwrap_or(Path::new("")))?;
        let cannot = || format!("cannot read {}", at.display());
        // Opening a device or a pipe can have effects or block, so the type is checked before and after.
        let found = statat(&folder, name, AtFlags::SYMLINK_NOFOLLOW).with_context(cannot)?;
        ensure!(FileType::from_raw_mode(found.st_mode) == FileType::RegularFile, is_link(&at));
        let flags =
            OFlags::RDONLY | OFlags::NOFOLLOW | OFlags::NONBLOCK | OFlags::NOCTTY | OFlags::CLOEXEC;
        let file = openat(&folder, name, flags, Mode::empty());
        let file = File::from(file.map_err(|error| refused(error, &at))?);
        ensure!(file.metadata().with_context(cannot)?.is_file(), is_link(&at));
        Ok(file)
    }

    /// Opens a folder beneath this one.
    ///
    /// # Errors
    /// As [`Self::file`].
    pub(crate) fn folder(&self, path: &Path) -> Result<OwnedFd> {
        self.walk(path, false)
    }

    /// Opens a folder beneath this one, and makes it if it does not exist.
    ///
    /// # Errors
    /// As [`Self::file`].
    pub(crate) fn make(&self, path: &Path) -> Result<OwnedFd> {
        self.walk(path, true)
    }

    fn walk(&self, path: &Path, makes: bool) -> Result<OwnedFd> {
        let (mut folder, mut at) = (self.root.try_clone()?, self.path.clone());
        for part in path.components() {
            let Component::Normal(part) = part else { bail!(self.leads_out(path)) };
            at.push(part);
            if makes {
                match mkdirat(&folder, part, Mode::from_raw_mode(0o755)) {
                    Ok(()) | Err(Errno::EXIST) => {}
                    Err(error) => bail!("cannot make {}: {error}", at.display()),
                }
            }
            folder = openat(&folder, part, FOLDER, Mode::empty())
                .map_err(|error| refused(error, &at))?;
        }
        Ok(folder)
    }

    /// Returns names and types in a folder beneath this one.
    fn list(&self, prefix: &str) -> Result<Vec<(String, FileType)>> {
        let folder = self.folder(Path::new(prefix))?;
        let at = self.path.join(prefix);
        let cannot = || format!("cannot read {}", at.display());
        let mut listed = Vec::new();
        for entry in Dir::read_from(&folder).with_context(cannot)? {
            let entry = entry.with_context(cannot)?;
            let name = entry.file_name();
            let text = name.to_str().ok().with_context(|| {
                format!(
                    "{}: the name {} is not valid UTF-8; rename it",
                    at.display(),
                    name.to_string_lossy()
                )
            })?;
            if [".", ".."].contains(&text) {
                continue;
            }
            // Some file systems list no types.
            let kind = match entry.file_type() {
                FileType::Unknown => {
                    let found =
                        statat(&folder, name, AtFlags::SYMLINK_NOFOLLOW).with_context(cannot)?;
                    FileType::from_raw_mode(found.st_mode)
                }
                kind => kind,
            };
            listed.push((text.to_owned(), kind));
        }
        Ok(listed)
    }

    fn leads_out(&self, path: &Path) -> String {
        format!("'{}' leads out of {}", path.display(), self.path.display())
    }

    fn too_many(&self, limit: &str) -> String {
        format!(
            "{} contains more than {limit}; move what the plugin does not need into a folder whose name starts with a \
             dot",
            self.path.display()
        )
    }
}

const FOLDER: OFlags =
    OFlags::RDONLY.union(OFlags::DIRECTORY).union(OFlags::NOFOLLOW).union(OFlags::CLOEXEC);

fn is_link(at: &Path) -> String {
    format!(
        "{} is a link or not a regular file; replace it by the file, or move it into a folder whose name starts with a \
         dot, which is left out",
        at.display()
    )
}

fn refused(error: Errno, at: &Path) -> anyhow::Error {
    match error {
        Errno::LOOP | Errno::NOTDIR => anyhow::anyhow!(is_link(at)),
        error => anyhow::Error::new(error).context(format!("cannot open {}", at.display())),
    }
}

/// Reads at most `most` bytes, and one more if there are more.
fn read(file: impl Read, most: u64) -> std::io::Result<Vec<u8>> {
    let mut content = Vec::new();
    file.take(most + 1).read_to_end(&mut content)?;
    Ok(content)
}

/// Reads a program that a build has made beneath `folder`.
///
/// # Errors
/// As [`Door::file`], or if it is larger than [`MOST_BYTES`].
pub(crate) fn read_program(folder: &Path, path: &Path) -> Result<Vec<u8>> {
    let content = read(Door::open(folder)?.file(path)?, MOST_BYTES)?;
    ensure!(
        content.len() as u64 <= MOST_BYTES,
        "{} has more than {MOST_BYTES} bytes; build it without debug information",
        path.display()
    );
    Ok(content)
}

/// Makes a folder that other users of the computer cannot enter; removed when dropped.
///
/// # Errors
/// If it cannot be made.
pub(crate) fn private_folder() -> Result<tempfile::TempDir> {
    let mode = std::os::unix::fs::PermissionsExt::from_mode(0o700);
    let folder = tempfile::Builder::new().prefix("vizflyt-").permissions(mode).tempdir();
    folder.with_context(|| format!("cannot make a folder in {}", std::env::temp_dir().display()))
}

/// Writes files into a new folder. All users can read them, because student code may run as another user; the folder
/// around it decides who gets there.
///
/// # Errors
/// If a file exists or cannot be written.
pub(crate) fn write(files: &Files, to: &Path) -> Result<()> {
    let mut make = fs::DirBuilder::new();
    make.recursive(true).mode(0o755);
    make.create(to).with_context(|| format!("cannot make {}", to.display()))?;
    for (path, content) in files {
        let path = to.join(path);
        let cannot = || format!("cannot write {}", path.display());
        make.create(path.parent().unwrap_or(to)).with_context(cannot)?;
        let is_program = content.starts_with(b"\x7fELF") || content.starts_with(b"#!");
        let mode = if is_program { 0o755 } else { 0o644 };
        let file = fs::OpenOptions::new().write(true).create_new(true).mode(mode).open(&path);
        file.and_then(|mut file| file.write_all(content)).with_context(cannot)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;
    use std::os::unix::net::UnixListener;

    use super::*;

    /// A folder with a plugin, and a secret next to it.
    fn scene() -> (tempfile::TempDir, PathBuf) {
        let outer = tempfile::tempdir().unwrap();
        let root = outer.path().join("mine");
        fs::create_dir_all(root.join("net")).unwrap();
        fs::create_dir(outer.path().join("secret")).unwrap();
        fs::write(root.join("plugin.py"), "import net").unwrap();
        fs::write(root.join("net/w.onnx"), "1").unwrap();
        fs::write(outer.path().join("secret/w.onnx"), "SECRET").unwrap();
        (outer, root)
    }

    fn files(root: &Path) -> Result<Files> {
        Door::open(root)?.files(&[])
    }

    #[test]
    fn copies_regular_files_only() {
        let (outer, root) = scene();
        for name in [
            ".git/config",
            "target/x",
            "venv/x",
            "env/pyvenv.cfg",
            "env/lib/x",
            "a/__pycache__/p",
            "old.pyc",
            "f.mcap",
        ] {
            fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
            fs::write(root.join(name), "").unwrap();
        }
        symlink("/etc", root.join(".venv")).unwrap();
        fs::write(root.join("key"), "SECRET").unwrap();
        let found = Door::open(&root).unwrap().files(&[root.join("key")]).unwrap();
        assert_eq!(found.keys().collect::<Vec<_>>(), ["net/w.onnx", "plugin.py"]);
        let copy = outer.path().join("copy");
        write(&found, &copy).unwrap();
        assert_eq!(files(&copy).unwrap(), found);
        assert!(write(&found, &copy).is_err(), "a copy never reuses a file");
    }

    #[test]
    fn rejects_links_devices_pipes_and_sockets() {
        let (outer, root) = scene();
        let bad = root.join("net/bad");
        let refused = |kind: &str| {
            let error = format!("{:#}", files(&root).unwrap_err());
            assert!(error.contains("net/bad is a link or not a regular file"), "{kind}: {error}");
            fs::remove_file(&bad).unwrap();
        };
        for aim in ["/etc/passwd", "../plugin.py", "../../secret", "absent"] {
            symlink(aim, &bad).unwrap();
            refused(aim);
        }
        // Reading a pipe without a writer would block.
        nix::unistd::mkfifo(&bad, nix::sys::stat::Mode::S_IRWXU).unwrap();
        refused("pipe");
        let socket = UnixListener::bind(&bad).unwrap();
        refused("socket");
        drop(socket);
        let device = nix::sys::stat::mknod(
            &bad,
            nix::sys::stat::SFlag::S_IFCHR,
            nix::sys::stat::Mode::S_IRWXU,
            nix::sys::stat::makedev(1, 3),
        );
        if device.is_ok() {
            refused("device");
        }
        assert!(files(&outer.path().join("absent")).is_err());
    }

    #[test]
    fn opens_nothing_outside_the_folder() {
        let (outer, root) = scene();
        let door = Door::open(&root).unwrap();
        let absolute = outer.path().join("secret/w.onnx");
        for path in [
            Path::new("../secret/w.onnx"),
            Path::new("net/../plugin.py"),
            &absolute,
            Path::new(".."),
        ] {
            assert!(door.file(path).is_err(), "{}", path.display());
            assert!(door.make(path).is_err(), "{}", path.display());
        }
        symlink(outer.path().join("secret"), root.join("target")).unwrap();
        let error = door.make(Path::new("target/confined")).unwrap_err().to_string();
        assert!(error.contains("target is a link"), "{error}");
        assert!(!outer.path().join("secret/confined").exists());
        door.make(Path::new("built/release")).unwrap();
        assert!(root.join("built/release").is_dir());
    }

    #[test]
    fn follows_no_link_that_replaces_a_listed_folder() {
        let (outer, root) = scene();
        let door = Door::open(&root).unwrap();
        let listed = door.list("").unwrap();
        assert!(listed.contains(&("net".into(), FileType::Directory)));
        fs::rename(root.join("net"), root.join("old")).unwrap();
        symlink(outer.path().join("secret"), root.join("net")).unwrap();
        assert!(door.list("net/").is_err());
        assert!(door.file(Path::new("net/w.onnx")).is_err());
        // A replaced root is still the folder that was opened.
        fs::rename(&root, outer.path().join("moved")).unwrap();
        symlink(outer.path().join("secret"), &root).unwrap();
        assert!(door.file(Path::new("w.onnx")).is_err());
        door.file(Path::new("old/w.onnx")).unwrap();
    }

    #[test]
    fn limits_bytes_files_folders_and_paths() {
        let (_outer, root) = scene();
        let refused = |part: &str| {
            let error = format!("{:#}", files(&root).unwrap_err());
            assert!(error.contains(part), "{error}");
        };
        File::create(root.join("large")).unwrap().set_len(MOST_BYTES).unwrap();
        refused("contains more than 209715200 bytes; move");
        fs::remove_file(root.join("large")).unwrap();
        for number in 0..MOST_FILES {
            fs::create_dir(root.join(format!("empty{number}"))).unwrap();
        }
        refused("contains more than 5000 files or folders");
        for number in 0..MOST_FILES {
            fs::remove_dir(root.join(format!("empty{number}"))).unwrap();
        }
        fs::create_dir_all(root.join(["deep"; 220].join("/"))).unwrap();
        refused("the path is too long");
    }
}
