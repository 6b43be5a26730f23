//! Folder of a report: allowed files, writing, and verification.
//!
//! ```text
//! each flight  --> images/, logs/, then flights/NAME.json, its record; each written atomically and flushed
//! the end      --> index.html, junit.xml, then grade.json, with the signed hash of every file
//! verify       --> names of changed, missing and added files
//! ```
//! Hashes are of the bytes that the grader wrote, not of the files: a plugin that can write there
//! cannot forge a report.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, Read, Seek, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use sha2::{Digest, Sha256};
use vizflyt_trust::hex;

use super::document::{Grade, SignedFile};

/// Signed grade.
pub(crate) const GRADE: &str = "grade.json";
/// Page of the report.
pub(crate) const PAGE: &str = "index.html";
/// Results for continuous integration.
pub(crate) const JUNIT: &str = "junit.xml";
/// Folders with the files of each flight.
pub(crate) const IMAGES: &str = "images";
pub(crate) const LOGS: &str = "logs";
pub(crate) const FLIGHTS: &str = "flights";
/// Prefix of the name of a file that is being written.
const DRAFT: &str = ".draft-";
/// Maximum number of names in a message.
const NAMED: usize = 12;
/// Maximum number of files; a folder with more is not a report.
const MAX_FILES: usize = 5_000_000;

/// Folder of a report that is being written.
#[derive(Clone, Debug)]
pub(crate) struct ReportFolder {
    root: PathBuf,
}

impl ReportFolder {
    /// Makes the folder, or empties that of an earlier report.
    ///
    /// # Errors
    /// If the folder contains other files, because all files in a report are signed, or finished
    /// flights of an interrupted grade.
    pub(crate) fn begin(root: &Path) -> Result<Self> {
        let folder = Self::make(root)?;
        let there = files_of(root)?;
        if !there.contains(GRADE) {
            let flown = there.iter().filter(|path| path.starts_with(FLIGHTS)).count();
            ensure!(
                flown == 0,
                "{} contains {flown} finished flights of an interrupted grade: keep them with --resume, or give \
                 another folder",
                root.display()
            );
        }
        let earlier = there.contains(GRADE).then(|| Grade::read(&root.join(GRADE))).transpose()?;
        let mut own: BTreeSet<String> = [GRADE, PAGE].map(str::to_owned).into();
        own.extend(earlier.into_iter().flat_map(|grade| grade.files).map(|file| file.path));
        let foreign: Vec<&String> = there.iter().filter(|path| !own.contains(*path)).collect();
        ensure!(
            foreign.is_empty() && (there.contains(GRADE) || there.is_empty()),
            "{} contains other files than a report's ({}); all files in a report are signed: give an empty folder",
            root.display(),
            list(&if foreign.is_empty() { there.iter().collect() } else { foreign })
        );
        for path in &there {
            folder.remove(path)?;
        }
        Ok(folder)
    }

    /// Replaces an earlier report by a complete one on the same disk.
    ///
    /// # Errors
    /// As for [`Self::begin`], or if it cannot be moved.
    pub(crate) fn replace(root: &Path, with: &Path) -> Result<()> {
        Self::begin(root)?;
        // Only folders remain of the earlier report.
        fs::remove_dir_all(root)
            .and_then(|()| fs::rename(with, root))
            .with_context(|| format!("cannot put the report into {}", root.display()))
    }

    /// Opens the folder of an interrupted grade, or makes it.
    ///
    /// # Errors
    /// If it contains files that no grade writes.
    pub(crate) fn resume(root: &Path) -> Result<Self> {
        let folder = Self::make(root)?;
        let there = files_of(root)?;
        let foreign: Vec<&String> = there.iter().filter(|path| !is_ours(path)).collect();
        ensure!(
            foreign.is_empty(),
            "{} contains other files than a report's ({}); all files in a report are signed: move them away",
            root.display(),
            list(&foreign)
        );
        Ok(folder)
    }

    fn make(root: &Path) -> Result<Self> {
        fs::create_dir_all(root).with_context(|| format!("cannot make {}", root.display()))?;
        Ok(Self { root: root.to_owned() })
    }

    /// Returns the path of a file in the folder.
    pub(crate) fn at(&self, path: &str) -> PathBuf {
        self.root.join(path)
    }

    /// Returns an unnamed file on the folder's disk: no other process can open it.
    ///
    /// # Errors
    /// If it cannot be made.
    pub(crate) fn nameless(&self) -> Result<File> {
        tempfile::tempfile_in(&self.root)
            .with_context(|| format!("cannot write in {}", self.root.display()))
    }

    /// Writes a file atomically: after a crash it is complete or absent.
    ///
    /// # Errors
    /// If it cannot be written.
    pub(crate) fn write(&self, path: &str, bytes: &[u8]) -> Result<SignedFile> {
        self.copy(path, &mut &*bytes)
    }

    /// Like [`Self::write`], with the content of a file from its start.
    ///
    /// # Errors
    /// If it cannot be read or written.
    pub(crate) fn write_file(&self, path: &str, mut source: &File) -> Result<SignedFile> {
        source.rewind().with_context(|| format!("cannot read the content for {path}"))?;
        self.copy(path, &mut source)
    }

    fn copy(&self, path: &str, source: &mut dyn Read) -> Result<SignedFile> {
        let to = self.at(path);
        let cannot = || format!("cannot write {}", to.display());
        let folder = to.parent().with_context(cannot)?;
        fs::create_dir_all(folder).with_context(cannot)?;
        let draft = tempfile::Builder::new().prefix(DRAFT).tempfile_in(folder);
        let mut draft = draft.with_context(cannot)?;
        // Readable for all users, like any other file: a report is for others.
        let open = std::os::unix::fs::PermissionsExt::from_mode(0o644);
        draft.as_file().set_permissions(open).with_context(cannot)?;
        let (mut hash, mut bytes, mut buffer) = (Sha256::new(), 0, vec![0; 1 << 16]);
        loop {
            let len = match source.read(&mut buffer) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                len => len.with_context(cannot)?,
            };
            if len == 0 {
                break;
            }
            hash.update(&buffer[..len]);
            draft.write_all(&buffer[..len]).with_context(cannot)?;
            bytes += len as u64;
        }
        draft.as_file().sync_all().with_context(cannot)?;
        draft.persist(&to).map_err(|error| error.error).with_context(cannot)?;
        // Flush the directory entry too, before anything that depends on the file is written.
        File::open(folder).and_then(|folder| folder.sync_all()).with_context(cannot)?;
        Ok(SignedFile { path: path.to_owned(), bytes, sha256: hex(&hash.finalize()) })
    }

    /// Returns the paths of the records in the folder.
    ///
    /// # Errors
    /// If the folder cannot be read.
    pub(crate) fn records(&self) -> Result<Vec<String>> {
        let is_record = |path: &String| {
            let name = path.strip_prefix(FLIGHTS).and_then(|rest| rest.strip_prefix('/'));
            name.is_some_and(|name| !name.starts_with(DRAFT))
        };
        Ok(files_of(&self.root)?.into_iter().filter(is_record).collect())
    }

    /// Removes all files of a grade except `kept`.
    ///
    /// # Errors
    /// If a file cannot be removed.
    pub(crate) fn keep_only(&self, kept: &BTreeSet<String>) -> Result<()> {
        for path in files_of(&self.root)?.iter().filter(|path| !kept.contains(*path)) {
            self.remove(path)?;
        }
        Ok(())
    }

    fn remove(&self, path: &str) -> Result<()> {
        let path = self.at(path);
        fs::remove_file(&path).with_context(|| format!("cannot remove {}", path.display()))
    }

    /// Checks that these files are unchanged.
    ///
    /// # Errors
    /// The names of changed or missing files.
    pub(crate) fn check(&self, files: &[SignedFile]) -> Result<()> {
        let found = differences(&self.root, files)?;
        let (changed, missing) = (list(&found.changed), list(&found.missing));
        ensure!(found.changed.is_empty(), "changed after it was written: {changed}");
        ensure!(found.missing.is_empty(), "missing: {missing}");
        Ok(())
    }
}

/// Checks that a folder contains exactly the files that its grade signs.
///
/// # Errors
/// The names of changed, missing and added files.
pub(crate) fn verify(root: &Path, grade: &Grade) -> Result<()> {
    ensure!(
        !grade.files.is_empty(),
        "the grade signs no files: it was made without --report, or by an earlier version"
    );
    let mut found = differences(root, &grade.files)?;
    found.added.retain(|path| path != GRADE);
    let kinds = [("changed", &found.changed), ("missing", &found.missing), ("added", &found.added)];
    let told: Vec<String> = kinds
        .iter()
        .filter(|(_, paths)| !paths.is_empty())
        .map(|(kind, paths)| format!("{kind}: {}", list(paths)))
        .collect();
    ensure!(told.is_empty(), "differs from the signed report: {}", told.join("; "));
    Ok(())
}

/// Returns whether a grade writes a file of this name.
fn is_ours(path: &str) -> bool {
    let in_folder = [IMAGES, LOGS, FLIGHTS]
        .iter()
        .any(|folder| path.strip_prefix(folder).is_some_and(|rest| rest.starts_with('/')));
    in_folder || [GRADE, PAGE, JUNIT].contains(&path) || path.starts_with(DRAFT)
}

/// Differences between a folder and a list of files.
#[derive(Debug, Default)]
struct Differences {
    changed: Vec<String>,
    missing: Vec<String>,
    added: Vec<String>,
}

fn differences(root: &Path, files: &[SignedFile]) -> Result<Differences> {
    let mut there = files_of(root)?;
    let mut found = Differences::default();
    for file in files {
        if !there.remove(&file.path) {
            found.missing.push(file.path.clone());
        } else if !is_same(&root.join(&file.path), file)? {
            found.changed.push(file.path.clone());
        }
    }
    found.added = there.into_iter().collect();
    Ok(found)
}

fn is_same(path: &Path, expected: &SignedFile) -> Result<bool> {
    // A link may point to the right bytes now and to others later.
    let info = fs::symlink_metadata(path).with_context(|| path.display().to_string())?;
    if !info.is_file() || info.len() != expected.bytes {
        return Ok(false);
    }
    let mut hash = Sha256::new();
    let mut file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    io::copy(&mut file, &mut hash).with_context(|| format!("cannot read {}", path.display()))?;
    Ok(hex(&hash.finalize()) == expected.sha256)
}

/// Returns the paths of all files in a folder, relative to it.
fn files_of(root: &Path) -> Result<BTreeSet<String>> {
    let mut found = BTreeSet::new();
    let mut folders = vec![(root.to_owned(), String::new())];
    while let Some((folder, prefix)) = folders.pop() {
        let cannot = || format!("cannot read {}", folder.display());
        for entry in fs::read_dir(&folder).with_context(cannot)? {
            let entry = entry.with_context(cannot)?;
            let path = format!("{prefix}{}", entry.file_name().to_string_lossy());
            if entry.file_type().with_context(cannot)?.is_dir() {
                folders.push((entry.path(), path + "/"));
            } else if found.len() >= MAX_FILES {
                bail!("{} contains more than {MAX_FILES} files; is it a report?", root.display());
            } else {
                found.insert(path);
            }
        }
    }
    Ok(found)
}

/// Returns the first names as text; names are escaped because they may contain any bytes.
pub(crate) fn list<T: AsRef<str>>(paths: &[T]) -> String {
    let named: Vec<String> =
        paths.iter().take(NAMED).map(|path| path.as_ref().escape_debug().to_string()).collect();
    match paths.len().checked_sub(NAMED) {
        Some(more) if more > 0 => format!("{} and {more} more", named.join(", ")),
        _ => named.join(", "),
    }
}

/// Returns the files sorted by path, each once; later ones replace earlier ones.
pub(crate) fn sorted(files: Vec<SignedFile>) -> Vec<SignedFile> {
    let by_path: BTreeMap<String, SignedFile> =
        files.into_iter().map(|file| (file.path.clone(), file)).collect();
    by_path.into_values().collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::document::tests::{grade, key};
    use super::*;

    /// Writes a report of these files and its signed grade.
    fn report(root: &Path, contents: &[(&str, &[u8])]) -> Grade {
        let folder = ReportFolder::begin(root).unwrap();
        let write = |(path, bytes): &(&str, &[u8])| folder.write(path, bytes).unwrap();
        let mut grade = grade();
        grade.files = sorted(contents.iter().map(write).collect());
        grade.sign(&key()).unwrap();
        folder.write(GRADE, grade.to_text().unwrap().as_bytes()).unwrap();
        grade
    }

    const CONTENTS: [(&str, &[u8]); 4] = [
        (PAGE, b"<p>won</p>"),
        (JUNIT, b"<testsuites/>"),
        ("images/day-1-00.jpg", b"\xff\xd8"),
        ("logs/day-1.mcap", b"MCAP"),
    ];

    fn refusal(root: &Path, grade: &Grade) -> String {
        verify(root, grade).unwrap_err().to_string()
    }

    #[test]
    fn names_changed_missing_and_added_files() {
        let temporary = tempfile::tempdir().unwrap();
        let root = temporary.path();
        let grade = report(root, &CONTENTS);
        verify(root, &grade).unwrap();
        for (path, bytes) in CONTENTS {
            let at = root.join(path);
            fs::write(&at, "other").unwrap();
            assert_eq!(
                refusal(root, &grade),
                format!("differs from the signed report: changed: {path}")
            );
            fs::remove_file(&at).unwrap();
            assert_eq!(
                refusal(root, &grade),
                format!("differs from the signed report: missing: {path}")
            );
            // A link to the right bytes is not the file.
            fs::write(root.join("other"), bytes).unwrap();
            std::os::unix::fs::symlink(root.join("other"), &at).unwrap();
            let expected = format!("differs from the signed report: changed: {path}; added: other");
            assert_eq!(refusal(root, &grade), expected);
            fs::remove_file(&at).unwrap();
            fs::rename(root.join("other"), &at).unwrap();
        }
        fs::create_dir(root.join("logs/deep")).unwrap();
        verify(root, &grade).unwrap();
        fs::write(root.join("logs/deep/\u{1b}[2J"), "").unwrap();
        let expected = "differs from the signed report: added: logs/deep/\\u{1b}[2J";
        assert_eq!(refusal(root, &grade), expected);
        let bare = Grade { files: Vec::new(), ..grade };
        assert!(refusal(root, &bare).contains("signs no files"));
    }

    #[test]
    fn replaces_an_earlier_report_and_rejects_other_folders() {
        let temporary = tempfile::tempdir().unwrap();
        let root = temporary.path();
        report(root, &CONTENTS);
        let grade = report(root, &CONTENTS[..2]);
        verify(root, &grade).unwrap();
        fs::write(root.join("thesis.tex"), "").unwrap();
        let error = ReportFolder::begin(root).unwrap_err().to_string();
        assert!(error.contains("thesis.tex") && error.contains("empty folder"), "{error}");
        let error = ReportFolder::resume(root).unwrap_err().to_string();
        assert!(error.contains("thesis.tex"), "{error}");
        assert!(root.join(PAGE).exists(), "nothing was removed");
        fs::remove_file(root.join("thesis.tex")).unwrap();
        // Interrupted: flights without a grade.
        fs::remove_file(root.join(GRADE)).unwrap();
        fs::create_dir(root.join(FLIGHTS)).unwrap();
        fs::write(root.join("flights/day-1.json"), "{}").unwrap();
        fs::write(root.join("flights/.draft-abc"), "").unwrap();
        fs::write(root.join(".draft-abc"), "").unwrap();
        let error = ReportFolder::begin(root).unwrap_err().to_string();
        assert!(error.contains("keep them with --resume"), "{error}");
        let folder = ReportFolder::resume(root).unwrap();
        assert_eq!(folder.records().unwrap(), ["flights/day-1.json"]);
        folder.keep_only(&["flights/day-1.json".to_owned()].into()).unwrap();
        assert_eq!(files_of(root).unwrap(), ["flights/day-1.json".to_owned()].into());
    }

    proptest! {
        /// Every change of any file is reported by name.
        #[test]
        fn detects_any_change(
            contents in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 1..50), 1..6),
            which in any::<prop::sample::Index>(), at in any::<prop::sample::Index>(), bits in 1u8..,
        ) {
            let temporary = tempfile::tempdir().unwrap();
            let names: Vec<String> = (0..contents.len()).map(|n| format!("images/{n}")).collect();
            let files: Vec<(&str, &[u8])> =
                names.iter().map(String::as_str).zip(contents.iter().map(Vec::as_slice)).collect();
            let grade = report(temporary.path(), &files);
            let which = which.index(contents.len());
            let mut changed = contents[which].clone();
            let at = at.index(changed.len());
            changed[at] ^= bits;
            fs::write(temporary.path().join(&names[which]), changed).unwrap();
            let expected = format!("differs from the signed report: changed: {}", names[which]);
            prop_assert_eq!(refusal(temporary.path(), &grade), expected);
        }
    }
}
