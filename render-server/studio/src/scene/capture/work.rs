//! The folder that a capture grows in: each stage's result is kept with a key of what it was made from, and taken
//! again as long as that is the same.
//!
//! ```text
//! my-hall/stages/images/          files of the stage `images`
//! my-hall/stages/images.json      its key, how long it took, its result; written last
//! ```
//! A stage's key holds the keys of those before it: one that is done again lets all after it be done again.

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Context, Result, ensure};
use clap::ValueEnum;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_process::print_fmt;
use vizflyt_trust::hex;

/// What is done, in this order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Stage {
    /// Sharp pictures of a video
    Images,
    /// Printed tags in them
    Tags,
    /// Where they were taken from
    Poses,
    /// The same in metres, and whether that is true
    Metric,
    /// Splats
    Train,
    /// What can be flown, and the report
    Finish,
}

impl Stage {
    fn name(self) -> &'static str {
        match self {
            Self::Images => "images",
            Self::Tags => "tags",
            Self::Poses => "poses",
            Self::Metric => "metric",
            Self::Train => "train",
            Self::Finish => "finish",
        }
    }
}

impl fmt::Display for Stage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// How long a stage took, and whether that was now.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct StageTime {
    pub(super) stage: Stage,
    pub(super) seconds: f64,
    /// Whether an earlier run did it.
    pub(super) kept: bool,
}

/// The folder, and how far the stages have come.
#[derive(Debug)]
pub(super) struct Work {
    folder: PathBuf,
    /// Done again from here on, whatever is kept.
    from: Option<Stage>,
    /// Of the last stage.
    key: String,
    times: Vec<StageTime>,
    /// The stage that is being done.
    running: Option<Stage>,
}

/// A stage's file.
#[derive(Serialize, Deserialize)]
struct Kept<T> {
    key: String,
    seconds: f64,
    result: T,
}

impl Work {
    /// Opens the folder of a capture; makes it where it is absent.
    ///
    /// # Errors
    /// A folder that holds something else.
    pub(super) fn open(output: &Path, from: Option<Stage>) -> Result<Self> {
        let folder = output.join("stages");
        let is_new = !folder.is_dir();
        if is_new && output.exists() {
            let mut entries = std::fs::read_dir(output)
                .with_context(|| format!("cannot read the folder {}", output.display()))?;
            ensure!(
                entries.next().is_none(),
                "{} holds something that no capture has written; give another folder to -o",
                output.display()
            );
        }
        std::fs::create_dir_all(&folder)
            .with_context(|| format!("cannot make the folder {}", folder.display()))?;
        Ok(Self { folder, from, key: String::new(), times: Vec::new(), running: None })
    }

    /// Returns the folder of a stage's files.
    pub(super) fn folder(&self, stage: Stage) -> PathBuf {
        self.folder.join(stage.name())
    }

    /// Whether a stage's result is kept, of whatever inputs, and will be looked at.
    pub(super) fn has(&self, stage: Stage) -> bool {
        self.from.is_none_or(|from| stage < from)
            && self.folder.join(format!("{stage}.json")).is_file()
    }

    /// Returns the file that tells whether arena.toml was edited.
    pub(super) fn mark(&self) -> PathBuf {
        self.folder.join("arena.sha256")
    }

    /// Says what the last stage made, and how long that took.
    pub(super) fn say(&self, made: &str) {
        if let Some(StageTime { stage, seconds, kept }) = self.times.last() {
            let took = if *kept { "kept".to_owned() } else { format!("{seconds:.0} s") };
            print_fmt!("{:<11} {made} ({took})", stage.name());
        }
    }

    /// Returns the stage that began last and has not come; that which has failed, after an error.
    pub(super) fn running(&self) -> Option<Stage> {
        self.running
    }

    /// Returns how long each stage took that has come.
    pub(super) fn times(&self) -> &[StageTime] {
        &self.times
    }

    /// Returns the result of a stage: what is kept of it, if that was made from the same `inputs`; else what `run`
    /// makes in the stage's folder, which is empty before.
    ///
    /// # Errors
    /// Those of `run`; nothing is kept then.
    pub(super) fn stage<T: Serialize + DeserializeOwned>(
        &mut self,
        stage: Stage,
        inputs: &impl Serialize,
        run: impl FnOnce(&Path) -> Result<T>,
    ) -> Result<T> {
        self.running = Some(stage);
        let text = serde_json::to_string(inputs)?;
        let mut hash = Sha256::new();
        for part in [env!("CARGO_PKG_VERSION"), stage.name(), &self.key, &text] {
            hash.update((part.len() as u64).to_le_bytes());
            hash.update(part);
        }
        self.key = hex(&hash.finalize());
        let file = self.folder.join(format!("{stage}.json"));
        if self.from.is_none_or(|from| stage < from)
            && let Some(kept) = kept::<T>(&file, &self.key)
        {
            self.times.push(StageTime { stage, seconds: kept.seconds, kept: true });
            self.running = None;
            return Ok(kept.result);
        }
        let files = self.folder(stage);
        // What a stopped run has left is of no use.
        for path in [&file, &files] {
            remove(path)?;
        }
        std::fs::create_dir_all(&files)
            .with_context(|| format!("cannot make the folder {}", files.display()))?;
        let start = Instant::now();
        let result = run(&files)?;
        let seconds = start.elapsed().as_secs_f64();
        self.times.push(StageTime { stage, seconds, kept: false });
        let kept = Kept { key: self.key.clone(), seconds, result };
        let part = file.with_extension("part");
        std::fs::write(&part, serde_json::to_string(&kept)?)
            .and_then(|()| std::fs::rename(&part, &file))
            .with_context(|| format!("cannot write {}", file.display()))?;
        self.running = None;
        Ok(kept.result)
    }
}

/// Returns what is kept under a key; what cannot be read is not kept.
fn kept<T: DeserializeOwned>(file: &Path, key: &str) -> Option<Kept<T>> {
    let text = std::fs::read_to_string(file).ok()?;
    serde_json::from_str(&text).ok().filter(|kept: &Kept<T>| kept.key == key)
}

fn remove(path: &Path) -> Result<()> {
    let removed =
        if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
    match removed {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(error).with_context(|| format!("cannot remove {}", path.display()))
        }
        _ => Ok(()),
    }
}

/// What tells whether a file is the same as before: its length, when it was written, and its ends. A video is too long
/// to be read whole each time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Fingerprint {
    path: PathBuf,
    bytes: u64,
    modified_ns: u128,
    ends_sha256: String,
}

impl Fingerprint {
    /// Takes a file's.
    pub(super) fn of(path: &Path) -> Result<Self> {
        use std::io::{Read, Seek, SeekFrom};
        let read = || -> std::io::Result<Self> {
            let mut file = std::fs::File::open(path)?;
            let metadata = file.metadata()?;
            let modified = metadata.modified()?.duration_since(std::time::UNIX_EPOCH);
            let mut hash = Sha256::new();
            let mut end = Vec::new();
            (&mut file).take(END_BYTES).read_to_end(&mut end)?;
            hash.update(&end);
            if metadata.len() > END_BYTES {
                file.seek(SeekFrom::End(-(END_BYTES as i64)))?;
                end.clear();
                file.take(END_BYTES).read_to_end(&mut end)?;
                hash.update(&end);
            }
            Ok(Self {
                path: path.to_owned(),
                bytes: metadata.len(),
                modified_ns: modified.map_or(0, |time| time.as_nanos()),
                ends_sha256: hex(&hash.finalize()),
            })
        };
        read().with_context(|| format!("cannot read {}", path.display()))
    }

    /// Takes those of all files below a folder, in the order of their names.
    pub(super) fn below(folder: &Path) -> Result<Vec<Self>> {
        let entries = std::fs::read_dir(folder)
            .with_context(|| format!("cannot read the folder {}", folder.display()))?;
        let mut paths: Vec<PathBuf> =
            entries.map(|entry| entry.map(|entry| entry.path())).collect::<std::io::Result<_>>()?;
        paths.sort();
        let mut all = Vec::new();
        for path in paths {
            if path.is_dir() {
                all.extend(Self::below(&path)?);
            } else {
                all.push(Self::of(&path)?);
            }
            ensure!(all.len() <= MAX_FILES, "{} holds too many files", folder.display());
        }
        Ok(all)
    }
}

/// Of a file's begin and end.
const END_BYTES: u64 = 1 << 20;
/// More are no capture.
const MAX_FILES: usize = 20_000;

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs two stages; returns which of them ran.
    fn run(output: &Path, inputs: [u32; 2], from: Option<Stage>) -> Vec<Stage> {
        let mut work = Work::open(output, from).unwrap();
        let mut ran = Vec::new();
        for (stage, input) in [Stage::Images, Stage::Poses].into_iter().zip(inputs) {
            let result = work.stage(stage, &input, |folder| {
                assert_eq!(std::fs::read_dir(folder).unwrap().count(), 0, "{stage} is not empty");
                std::fs::write(folder.join("made"), "x")?;
                ran.push(stage);
                Ok(input * 2)
            });
            assert_eq!(result.unwrap(), input * 2);
            assert!(work.folder(stage).join("made").is_file());
        }
        assert_eq!(work.times().iter().filter(|time| !time.kept).count(), ran.len());
        ran
    }

    #[test]
    fn what_has_not_changed_is_kept() {
        use Stage::{Images, Poses};
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("hall");
        assert_eq!(run(&output, [1, 1], None), [Images, Poses]);
        assert_eq!(run(&output, [1, 1], None), []);
        assert_eq!(run(&output, [1, 2], None), [Poses]);
        // What comes after what changed is done again, though its own inputs are the same.
        assert_eq!(run(&output, [2, 2], None), [Images, Poses]);
        assert_eq!(run(&output, [2, 2], Some(Poses)), [Poses]);
        assert_eq!(run(&output, [2, 2], Some(Images)), [Images, Poses]);
        // A damaged result is none.
        std::fs::write(output.join("stages/images.json"), "{").unwrap();
        assert_eq!(run(&output, [2, 2], None), [Images]);
    }

    #[test]
    fn a_stage_that_fails_is_not_kept() {
        let folder = tempfile::tempdir().unwrap();
        let mut work = Work::open(folder.path(), None).unwrap();
        let failed: Result<u32> = work.stage(Stage::Images, &1, |_| anyhow::bail!("no"));
        assert!(failed.is_err());
        assert_eq!(work.running(), Some(Stage::Images));
        let mut work = Work::open(folder.path(), None).unwrap();
        assert_eq!(work.stage(Stage::Images, &1, |_| Ok(7)).unwrap(), 7);
        assert_eq!(work.running(), None);
    }

    #[test]
    fn a_folder_of_something_else_is_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("thesis.tex"), "x").unwrap();
        let error = Work::open(folder.path(), None).unwrap_err().to_string();
        assert!(error.contains("another folder"), "{error}");
    }

    #[test]
    fn a_changed_file_has_another_fingerprint() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("hall.mp4");
        let mut bytes = vec![7; 3 << 20];
        std::fs::write(&path, &bytes).unwrap();
        let before = Fingerprint::of(&path).unwrap();
        assert_eq!(before, Fingerprint::of(&path).unwrap());
        *bytes.last_mut().unwrap() = 8;
        std::fs::write(&path, &bytes).unwrap();
        let after = Fingerprint::of(&path).unwrap();
        assert_ne!(before.ends_sha256, after.ends_sha256);
        assert_eq!(Fingerprint::below(folder.path()).unwrap(), [after]);
    }
}
