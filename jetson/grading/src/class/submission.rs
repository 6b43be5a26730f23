//! A team's submission: files of the plugin's folder, packed by `vizflyt submit` and unpacked by
//! `vizflyt grade-class`.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use sha2::{Digest, Sha256};
use vizflyt_process::print_fmt;
use vizflyt_trust::hex;

use super::archive::{MOST_BYTES, open, pack, without_outer_folder};
use super::{hash, write};
use crate::door::{self, Door};
use crate::plugin::Plugin;

/// Pack the folder of a plugin for submission
#[derive(Args, Debug)]
#[command(
    after_help = "Not packed: names that begin with a dot (.venv, .git), target, venv, __pycache__, node_modules, flights,
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
    let files = Door::open(folder)?.files(&[])?;
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
/// If there is none, both a folder and an archive, or a link.
pub(super) fn find(submissions: &Path, team: &str) -> Result<Submission> {
    let (folder, archive) = (submissions.join(team), submissions.join(format!("{team}.zip")));
    for path in [&folder, &archive] {
        ensure!(!path.is_symlink(), "{} is a link; replace it by its content", path.display());
    }
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
            Self::Folder(folder) => Ok(hash(&pack(&Door::open(folder)?.files(&[])?)?)),
            Self::Archive(path) => {
                let mut digest = Sha256::new();
                io::copy(&mut archive(path)?, &mut digest)
                    .with_context(|| format!("cannot read {}", path.display()))?;
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
            Self::Folder(folder) => Door::open(folder)?.files(&[])?,
            Self::Archive(path) => {
                let cannot = || format!("{} is not a valid submission", path.display());
                let mut bytes = Vec::new();
                archive(path)?.take(MOST_BYTES + 1).read_to_end(&mut bytes).with_context(cannot)?;
                ensure!(
                    bytes.len() as u64 <= MOST_BYTES,
                    "{}: has more than {MOST_BYTES} bytes",
                    path.display()
                );
                without_outer_folder(open(&bytes).with_context(cannot)?)
            }
        };
        door::write(&files, to)
    }
}

fn archive(path: &Path) -> Result<File> {
    let name = path.file_name().unwrap_or_default();
    Door::open(path.parent().unwrap_or(Path::new("")))?.file(Path::new(name))
}

#[cfg(test)]
mod tests {
    use super::super::archive::Files;
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
        let read = Door::open(folder.path()).unwrap().files(&[]).unwrap();
        assert_eq!(read, files(&["net/w.onnx", "plugin.py", "vizflyt.toml"]));
        let bytes = pack(&read).unwrap();
        assert_eq!(bytes, pack(&read).unwrap(), "contains no times");
        assert_eq!(open(&bytes).unwrap(), read);
        std::os::unix::fs::symlink("/etc/passwd", folder.path().join("x")).unwrap();
        let error = Door::open(folder.path()).unwrap().files(&[]).unwrap_err();
        assert!(error.to_string().contains("is a link"), "{error}");
    }
}
