//! Stages of a capture and their cache. Each result is stored with a key of its inputs, and reused while the key is the
//! same.
//!
//! ```text
//! my-hall/stages/images/          files of the stage `images`
//! my-hall/stages/images.json      key, duration and result; written last
//! ```
//! The key of a stage includes the keys of the previous stages. After a stage that runs again, all later ones do too.

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

/// Stages in their order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Stage {
    /// Select sharp pictures of the video
    Images,
    /// Detect printed tags
    Tags,
    /// Estimate the camera poses
    Poses,
    /// Determine and verify scale and axes, in metres
    Metric,
    /// Train the splats
    Train,
    /// Write fence, start and report
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

/// Duration of a stage, and whether its result was reused.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct StageTime {
    pub(super) stage: Stage,
    pub(super) seconds: f64,
    /// Whether the result is from an earlier run.
    pub(super) kept: bool,
}

/// Folder and progress of the stages.
#[derive(Debug)]
pub(super) struct Work {
    folder: PathBuf,
    /// Stages from this one on run again, even if results are stored.
    from: Option<Stage>,
    /// Key of the last stage.
    key: String,
    times: Vec<StageTime>,
    /// Running stage.
    running: Option<Stage>,
}

/// Content of a stage's JSON file.
#[derive(Serialize, Deserialize)]
struct Kept<T> {
    key: String,
    seconds: f64,
    result: T,
}

impl Work {
    /// Opens the folder of a capture, and creates it if it is missing.
    ///
    /// # Errors
    /// The folder contains other files.
    pub(super) fn open(output: &Path, from: Option<Stage>) -> Result<Self> {
        let folder = output.join("stages");
        let is_new = !folder.is_dir();
        if is_new && output.exists() {
            let mut entries = std::fs::read_dir(output)
                .with_context(|| format!("cannot read the folder {}", output.display()))?;
            ensure!(
                entries.next().is_none(),
                "{} contains files that are not of a capture; give another folder to -o",
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

    /// Whether a result of the stage is stored (for any inputs) and may be reused.
    pub(super) fn has(&self, stage: Stage) -> bool {
        self.from.is_none_or(|from| stage < from)
            && self.folder.join(format!("{stage}.json")).is_file()
    }

    /// Returns the file with the hash of the written arena.toml, to detect edits.
    pub(super) fn mark(&self) -> PathBuf {
        self.folder.join("arena.sha256")
    }

    /// Prints the result and the duration of the last stage.
    pub(super) fn say(&self, made: &str) {
        if let Some(StageTime { stage, seconds, kept }) = self.times.last() {
            let took = if *kept { "kept".to_owned() } else { format!("{seconds:.0} s") };
            print_fmt!("{:<11} {made} ({took})", stage.name());
        }
    }

    /// Returns the stage that is running or, after an error, has failed.
    pub(super) fn running(&self) -> Option<Stage> {
        self.running
    }

    /// Returns the durations of the completed stages.
    pub(super) fn times(&self) -> &[StageTime] {
        &self.times
    }

    /// Returns the result of a stage: the stored one if its `inputs` are unchanged, otherwise that of `run`, which gets
    /// the empty folder of the stage.
    ///
    /// # Errors
    /// Errors of `run`; in this case, nothing is stored.
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
        // Files of an interrupted run cannot be used.
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

/// Returns the stored result with this key; `None` if there is none or it cannot be read.
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

/// Fingerprint to detect changes of a file: length, modification time, and hash of both ends. A video is too large to
/// hash completely each time.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Fingerprint {
    path: PathBuf,
    bytes: u64,
    modified_ns: u128,
    ends_sha256: String,
}

impl Fingerprint {
    /// Computes the fingerprint of a file.
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

    /// Computes the fingerprints of all files below a folder, in order of their names.
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
            ensure!(
                all.len() <= MAX_FILES,
                "{} holds too many files; give a new folder to -o",
                folder.display()
            );
        }
        Ok(all)
    }
}

/// Size of each hashed end of a file.
const END_BYTES: u64 = 1 << 20;
/// Maximum number of files of a capture.
const MAX_FILES: usize = 20_000;

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs two stages. Returns the stages that were not reused.
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
    fn reuses_stages_with_unchanged_inputs() {
        use Stage::{Images, Poses};
        let folder = tempfile::tempdir().unwrap();
        let output = folder.path().join("hall");
        assert_eq!(run(&output, [1, 1], None), [Images, Poses]);
        assert_eq!(run(&output, [1, 1], None), []);
        assert_eq!(run(&output, [1, 2], None), [Poses]);
        // Stages after a changed one run again, even if their own inputs are the same.
        assert_eq!(run(&output, [2, 2], None), [Images, Poses]);
        assert_eq!(run(&output, [2, 2], Some(Poses)), [Poses]);
        assert_eq!(run(&output, [2, 2], Some(Images)), [Images, Poses]);
        // A damaged result is not used.
        std::fs::write(output.join("stages/images.json"), "{").unwrap();
        assert_eq!(run(&output, [2, 2], None), [Images]);
    }

    #[test]
    fn stores_nothing_of_a_failed_stage() {
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
    fn rejects_a_folder_with_other_files() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("thesis.tex"), "x").unwrap();
        let error = Work::open(folder.path(), None).unwrap_err().to_string();
        assert!(error.contains("another folder"), "{error}");
    }

    #[test]
    fn a_fingerprint_detects_changes_at_the_end_of_a_file() {
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
