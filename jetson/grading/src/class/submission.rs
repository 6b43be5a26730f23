//! A team's submission: files of the plugin's folder, packed by `vizflyt submit` and unpacked by
//! `vizflyt grade-class`.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use sha2::{Digest, Sha256};
use vizflyt_process::print_fmt;
use vizflyt_trust::hex;

use super::archive::{Files, MOST_BYTES, MOST_FILES, open, pack, without_outer_folder};
use super::{hash, write};
use crate::plugin::Plugin;

/// Generated folders, which are not packed.
const MADE: [&str; 4] = ["target", "__pycache__", "node_modules", "flights"];

/// Pack the folder of a plugin for submission
#[derive(Args, Debug)]
#[command(
    after_help = "Not packed: names that begin with a dot (.venv, .git), target, __pycache__, node_modules, flights,
*.pyc and *.mcap. The same files give the same archive, so its SHA-256 identifies the submission.

Examples:
  vizflyt submit p4 -o red.zip            for team red; then hand red.zip in
  vizflyt grade p4 --project p4 --seeds 20 --first-seed 1000      before that: practice, on other seeds"
)]
pub struct SubmitArgs {
    /// Folder of the plugin
    folder: PathBuf,
    /// Archive to write; name it after the team [default: FOLDER.zip]
    #[arg(short, long, value_name = "TEAM.zip")]
    output: Option<PathBuf>,
}

/// Runs `vizflyt submit`.
pub fn submit(args: &SubmitArgs) -> Result<ExitCode> {
    let folder = &args.folder;
    ensure!(folder.is_dir(), "{} is not a folder; give the folder of the plugin", folder.display());
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

/// Submission of a team.
pub(super) enum Submission {
    Folder(PathBuf),
    Archive(PathBuf),
}

/// Finds the submission of a team.
///
/// # Errors
/// If there is none, or both a folder and an archive.
pub(super) fn find(submissions: &Path, team: &str) -> Result<Submission> {
    let (folder, archive) = (submissions.join(team), submissions.join(format!("{team}.zip")));
    match (folder.is_dir(), archive.is_file()) {
        (true, true) => {
            bail!("{} and {} both exist; delete one of them", folder.display(), archive.display())
        }
        (true, false) => Ok(Submission::Folder(folder)),
        (false, true) => Ok(Submission::Archive(archive)),
        (false, false) => {
            bail!("nothing submitted: neither {} nor a folder of that name", archive.display())
        }
    }
}

impl Submission {
    /// Returns the hash of the archive; of a folder, the hash of the archive that `pack` makes of
    /// it.
    pub(super) fn sha256(&self) -> Result<String> {
        match self {
            Self::Folder(folder) => Ok(hash(&pack(&read_folder(folder)?)?)),
            Self::Archive(path) => {
                let mut digest = Sha256::new();
                let cannot = || format!("cannot read {}", path.display());
                io::copy(&mut File::open(path).with_context(cannot)?, &mut digest)
                    .with_context(cannot)?;
                Ok(hex(&digest.finalize()))
            }
        }
    }

    /// Writes the files into an empty folder.
    ///
    /// # Errors
    /// If the submission is invalid.
    pub(super) fn unpack(&self, to: &Path) -> Result<()> {
        let files = match self {
            Self::Folder(folder) => read_folder(folder)?,
            Self::Archive(path) => {
                let cannot = || format!("{} is not a valid submission", path.display());
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

/// Makes a folder readable for all users.
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
            let name = name.to_str().with_context(|| {
                format!("{}: the name is not valid UTF-8", entry.path().display())
            })?;
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
                "{} is a link or not a regular file; submit the file itself",
                entry.path().display()
            );
            total += entry.metadata().with_context(cannot)?.len();
            ensure!(
                total <= MOST_BYTES,
                "{} contains more than {MOST_BYTES} bytes",
                root.display()
            );
            ensure!(
                files.len() < MOST_FILES,
                "{} contains more than {MOST_FILES} files",
                root.display()
            );
            files.insert(path, fs::read(entry.path()).with_context(cannot)?);
        }
    }
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn files(paths: &[&str]) -> Files {
        paths.iter().map(|path| ((*path).to_owned(), path.as_bytes().to_vec())).collect()
    }

    #[test]
    fn unpacks_what_was_packed_without_generated_files() {
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
        assert_eq!(bytes, pack(&read).unwrap(), "contains no times");
        assert_eq!(open(&bytes).unwrap(), read);
        std::os::unix::fs::symlink("/etc/passwd", folder.path().join("x")).unwrap();
        assert!(read_folder(folder.path()).unwrap_err().to_string().contains("is a link"));
    }
}
