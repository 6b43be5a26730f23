//! A team's hand-in: a ZIP of its plugin's folder, made by `vizflyt submit` and unpacked by `vizflyt grade-class`.
//!
//! Whoever made it: it may name no place outside, no link, and holds no more than [`MOST_BYTES`].

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Cursor, Read, Write};
use std::path::{Component, Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use sha2::{Digest, Sha256};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipArchive, ZipWriter};

use super::{hash, write};
use crate::fly::plugin::Plugin;
use crate::terminal::print_fmt;

/// All files together. [bytes]
const MOST_BYTES: u64 = 200 << 20;
const MOST_FILES: usize = 5000;
/// Folders that a computer makes by itself.
const MADE: [&str; 4] = ["target", "__pycache__", "node_modules", "flights"];

/// Packs a plugin's folder as a team hands it in.
#[derive(Args, Debug)]
#[command(
    after_help = "What begins with a dot stays out (.venv, .git), and so do target, __pycache__, node_modules, flights, *.pyc and
*.mcap. The same files make the same archive, so its SHA-256 says what was handed in.

Examples:
  vizflyt submit p4 -o red.zip            for team red; then hand red.zip in
  vizflyt grade p4 --project p4 --seeds 20 --first-seed 1000      before that: practice, on other seeds"
)]
pub(crate) struct SubmitArgs {
    /// The plugin's folder
    folder: PathBuf,
    /// The archive; call it as your team is called [default: FOLDER.zip]
    #[arg(short, long, value_name = "TEAM.zip")]
    output: Option<PathBuf>,
}

/// Runs `vizflyt submit`.
pub(crate) fn submit(args: &SubmitArgs) -> Result<ExitCode> {
    let folder = &args.folder;
    ensure!(folder.is_dir(), "{} is no folder; give that of your plugin", folder.display());
    Plugin::find(folder.as_os_str())?;
    let files = read_folder(folder)?;
    let bytes = pack(&files)?;
    let name = folder.canonicalize().ok().and_then(|path| Some(path.file_name()?.to_owned()));
    let output = args
        .output
        .clone()
        .unwrap_or_else(|| PathBuf::from(name.unwrap_or_default()).with_extension("zip"));
    write(&output, &bytes)?;
    for (path, content) in &files {
        print_fmt!("{:>9}  {path}", content.len());
    }
    print_fmt!("{}: {} files, {} bytes", output.display(), files.len(), bytes.len());
    print_fmt!("SHA-256     {}", hash(&bytes));
    Ok(ExitCode::SUCCESS)
}

/// What a team has handed in.
pub(super) enum Submission {
    Folder(PathBuf),
    Archive(PathBuf),
}

/// Finds a team's hand-in.
///
/// # Errors
/// There is none, or two.
pub(super) fn find(submissions: &Path, team: &str) -> Result<Submission> {
    let (folder, archive) = (submissions.join(team), submissions.join(format!("{team}.zip")));
    match (folder.is_dir(), archive.is_file()) {
        (true, true) => {
            bail!("there are both {} and {}; leave one", folder.display(), archive.display())
        }
        (true, false) => Ok(Submission::Folder(folder)),
        (false, true) => Ok(Submission::Archive(archive)),
        (false, false) => {
            bail!("nothing handed in: neither {} nor a folder of that name", archive.display())
        }
    }
}

impl Submission {
    /// Returns the hash of an archive, or of the archive that a folder would be.
    pub(super) fn sha256(&self) -> Result<String> {
        match self {
            Self::Folder(folder) => Ok(hash(&pack(&read_folder(folder)?)?)),
            Self::Archive(path) => {
                let mut digest = Sha256::new();
                let cannot = || format!("cannot read {}", path.display());
                io::copy(&mut File::open(path).with_context(cannot)?, &mut digest)
                    .with_context(cannot)?;
                Ok(digest
                    .finalize()
                    .iter()
                    .fold(String::new(), |text, byte| text + &format!("{byte:02x}")))
            }
        }
    }

    /// Writes its files into a folder of their own.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn unpack(&self, to: &Path) -> Result<()> {
        let files = match self {
            Self::Folder(folder) => read_folder(folder)?,
            Self::Archive(path) => {
                let cannot = || format!("{} is no hand-in", path.display());
                let size = fs::metadata(path).with_context(cannot)?.len();
                ensure!(
                    size <= MOST_BYTES,
                    "{}: {size} bytes are more than {MOST_BYTES}",
                    path.display()
                );
                without_outer_folder(
                    open(&fs::read(path).with_context(cannot)?).with_context(cannot)?,
                )
            }
        };
        for (path, content) in &files {
            write(&to.join(path), content)?;
        }
        // Student code runs as another user.
        readable(to)
    }
}

/// A hand-in's files by their paths, with `/`.
type Files = BTreeMap<String, Vec<u8>>;

/// Lets everybody read a folder.
fn readable(folder: &Path) -> Result<()> {
    use std::os::unix::fs::PermissionsExt;
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        if path.is_dir() {
            readable(&path)?;
        } else {
            let is_program = File::open(&path).is_ok_and(|mut file| {
                let mut magic = [0; 4];
                file.read_exact(&mut magic).is_ok()
                    && (magic == *b"\x7fELF" || magic[..2] == *b"#!")
            });
            fs::set_permissions(
                &path,
                PermissionsExt::from_mode(if is_program { 0o755 } else { 0o644 }),
            )?;
        }
    }
    Ok(fs::set_permissions(folder, PermissionsExt::from_mode(0o755))?)
}

fn read_folder(root: &Path) -> Result<Files> {
    let mut files = Files::new();
    let mut left = vec![(root.to_owned(), String::new())];
    let mut total = 0;
    while let Some((folder, prefix)) = left.pop() {
        let cannot = || format!("cannot read {}", folder.display());
        for entry in fs::read_dir(&folder).with_context(cannot)? {
            let entry = entry.with_context(cannot)?;
            let name = entry.file_name();
            let name = name
                .to_str()
                .with_context(|| format!("{}: a name that is no text", entry.path().display()))?;
            let (kind, path) = (entry.file_type().with_context(cannot)?, format!("{prefix}{name}"));
            let is_made =
                Path::new(name).extension().is_some_and(|end| end == "pyc" || end == "mcap");
            if name.starts_with('.') || is_made {
                continue;
            }
            if kind.is_dir() {
                if !MADE.contains(&name) {
                    left.push((entry.path(), format!("{path}/")));
                }
                continue;
            }
            ensure!(
                kind.is_file(),
                "{} is a link or no file; hand in the file itself",
                entry.path().display()
            );
            total += entry.metadata().with_context(cannot)?.len();
            ensure!(total <= MOST_BYTES, "{} holds more than {MOST_BYTES} bytes", root.display());
            ensure!(
                files.len() < MOST_FILES,
                "{} holds more than {MOST_FILES} files",
                root.display()
            );
            files.insert(path, fs::read(entry.path()).with_context(cannot)?);
        }
    }
    Ok(files)
}

/// Makes an archive: the same files make the same bytes.
fn pack(files: &Files) -> Result<Vec<u8>> {
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default()
        .compression_method(CompressionMethod::Deflated)
        .last_modified_time(zip::DateTime::default());
    for (path, content) in files {
        archive.start_file(path.as_str(), options)?;
        archive.write_all(content)?;
    }
    Ok(archive.finish()?.into_inner())
}

/// Reads an archive that anybody may have made.
fn open(bytes: &[u8]) -> Result<Files> {
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    ensure!(archive.len() <= MOST_FILES, "{} files are more than {MOST_FILES}", archive.len());
    let mut files = Files::new();
    let mut left = MOST_BYTES;
    for index in 0..archive.len() {
        let part = archive.by_index(index)?;
        let name = part.name()?.into_owned();
        if part.is_dir() {
            continue;
        }
        let is_within = !name.contains(['\\', '\0'])
            && !name.is_empty()
            && Path::new(&name).components().all(|part| matches!(part, Component::Normal(_)));
        ensure!(is_within, "'{}' leads out of it", name.escape_debug());
        ensure!(part.is_file(), "'{}' is a link", name.escape_debug());
        // What it says of its size is its own word.
        let mut content = Vec::new();
        part.take(left + 1).read_to_end(&mut content)?;
        left = left
            .checked_sub(content.len() as u64)
            .with_context(|| format!("it holds more than {MOST_BYTES} bytes"))?;
        let name = Path::new(&name)
            .components()
            .map(|part| part.as_os_str().to_string_lossy())
            .collect::<Vec<_>>()
            .join("/");
        ensure!(
            files.insert(name.clone(), content).is_none(),
            "'{}' is there twice",
            name.escape_debug()
        );
    }
    for path in files.keys() {
        let is_folder = path.match_indices('/').any(|(at, _)| files.contains_key(&path[..at]));
        ensure!(!is_folder, "'{}' lies in a file", path.escape_debug());
    }
    Ok(files)
}

/// Takes off the folder that other programs put about all files.
fn without_outer_folder(files: Files) -> Files {
    let outer = files
        .keys()
        .next()
        .and_then(|path| path.split_once('/'))
        .map(|(outer, _)| format!("{outer}/"));
    match outer {
        Some(outer) if files.keys().all(|path| path.starts_with(&outer)) => files
            .into_iter()
            .map(|(path, content)| (path[outer.len()..].to_owned(), content))
            .collect(),
        _ => files,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn files(paths: &[&str]) -> Files {
        paths.iter().map(|path| ((*path).to_owned(), path.as_bytes().to_vec())).collect()
    }

    #[test]
    fn what_is_packed_is_unpacked_and_what_a_computer_made_stays_out() {
        let folder = tempfile::tempdir().unwrap();
        let all = [
            "plugin.py",
            "vizflyt.toml",
            "net/w.onnx",
            ".venv/bin/python3",
            "target/x",
            "a/__pycache__/p.pyc",
            "f.mcap",
        ];
        for path in all {
            write(&folder.path().join(path), path.as_bytes()).unwrap();
        }
        let read = read_folder(folder.path()).unwrap();
        assert_eq!(read, files(&["net/w.onnx", "plugin.py", "vizflyt.toml"]));
        let bytes = pack(&read).unwrap();
        assert_eq!(bytes, pack(&read).unwrap(), "no time is in it");
        assert_eq!(open(&bytes).unwrap(), read);
        // As a file manager packs a folder.
        let outer =
            read.iter().map(|(path, content)| (format!("p4/{path}"), content.clone())).collect();
        assert_eq!(without_outer_folder(outer), read);
        assert_eq!(without_outer_folder(read.clone()), read);
        std::os::unix::fs::symlink("/etc/passwd", folder.path().join("x")).unwrap();
        assert!(read_folder(folder.path()).unwrap_err().to_string().contains("is a link"));
    }

    #[test]
    fn an_archive_leads_nowhere_else_and_grows_to_no_size() {
        for path in ["../up", "/etc/x", "a/../../x", "a\\..\\x"] {
            let error = open(&pack(&files(&[path])).unwrap()).unwrap_err().to_string();
            assert!(error.contains("leads out"), "{path}: {error}");
        }
        let error = open(&pack(&files(&["a", "a/b"])).unwrap()).unwrap_err().to_string();
        assert!(error.contains("lies in a file"), "{error}");
        let bomb = BTreeMap::from([("zeros".to_owned(), vec![0; (MOST_BYTES + 1) as usize])]);
        let bytes = pack(&bomb).unwrap();
        assert!(bytes.len() < 1 << 20, "{}", bytes.len());
        assert!(open(&bytes).unwrap_err().to_string().contains("holds more than"));
        let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
        archive.add_symlink("x", "/etc/passwd", SimpleFileOptions::default()).unwrap();
        let bytes = archive.finish().unwrap().into_inner();
        assert!(open(&bytes).unwrap_err().to_string().contains("'x' is a link"));
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(at in 0usize..300, value: u8, cut in 0usize..300) {
            let mut bytes = pack(&files(&["plugin.py", "net/w.onnx"])).unwrap();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut % bytes.len());
            for (path, _) in open(&bytes).into_iter().flatten() {
                prop_assert!(Path::new(&path).components().all(|part| matches!(part, Component::Normal(_))));
            }
        }
    }
}
