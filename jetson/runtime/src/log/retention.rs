//! Retention of flight logs: when a flight begins, deletes the oldest logs until the rest is within a
//! maximum size and age.
//!
//! Only files with the name of a log are deleted (`2026-11-21T04-09-21.123Z.mcap`): rename a log to keep
//! it. A log that is being written is locked, and is kept.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Maximum size and age of flight logs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Retention {
    /// Maximum total size. [bytes]
    pub max_bytes: u64,
    /// Maximum age since the flight's end; `None` for no limit.
    pub max_age: Option<Duration>,
}

impl Retention {
    /// No limits: keeps every log.
    pub const FOREVER: Self = Self { max_bytes: u64::MAX, max_age: None };
}

/// Number and size of deleted logs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Deleted {
    pub(super) logs: u64,
    pub(super) bytes: u64,
}

impl Deleted {
    /// Returns a sentence for the operator; `None` if nothing was deleted.
    pub(super) fn sentence(self, retention: Retention) -> Option<String> {
        let Self { logs, bytes } = self;
        if logs == 0 {
            return None;
        }
        let age =
            retention.max_age.map(|age| format!(" and {:.0} days", age.as_secs_f64() / DAY_S));
        Some(format!(
            "deleted the {logs} oldest flight logs, {:.1} GB: [log] keeps {:.1} GB{}",
            bytes as f64 / 1e9,
            retention.max_bytes as f64 / 1e9,
            age.unwrap_or_default()
        ))
    }
}

const DAY_S: f64 = 86_400.0;

struct Log {
    path: PathBuf,
    bytes: u64,
    ended: SystemTime,
}

/// Deletes the oldest logs of `folder` beyond `retention`.
///
/// # Errors
/// If the folder cannot be listed. Logs that cannot be deleted are skipped.
pub(super) fn delete_old(
    folder: &Path,
    retention: Retention,
    now: SystemTime,
) -> io::Result<Deleted> {
    let mut logs = Vec::new();
    for entry in fs::read_dir(folder)? {
        let path = entry?.path();
        let is_log = path.file_name().and_then(|name| name.to_str()).is_some_and(is_log_name);
        let metadata = path.symlink_metadata().ok().filter(fs::Metadata::is_file);
        if let (true, Some(metadata)) = (is_log, metadata) {
            logs.push(Log { path, bytes: metadata.len(), ended: metadata.modified()? });
        }
    }
    // Names sort by time.
    logs.sort_by(|a, b| a.path.cmp(&b.path));
    let mut total: u64 = logs.iter().map(|log| log.bytes).sum();
    let mut deleted = Deleted::default();
    for log in logs {
        let age = now.duration_since(log.ended).unwrap_or_default();
        let is_old = retention.max_age.is_some_and(|max_age| age > max_age);
        if (is_old || total > retention.max_bytes) && delete_unless_in_use(&log.path) {
            total -= log.bytes;
            deleted.logs += 1;
            deleted.bytes += log.bytes;
        }
    }
    Ok(deleted)
}

/// Deletes a log that is not locked; returns whether it was deleted.
fn delete_unless_in_use(path: &Path) -> bool {
    let is_free = File::open(path).is_ok_and(|file| file.try_lock().is_ok());
    is_free && fs::remove_file(path).is_ok()
}

/// Whether a file name is the original name of a log.
fn is_log_name(name: &str) -> bool {
    const SHAPE: &[u8] = b"0000-00-00T00-00-00.000Z.mcap";
    name.len() == SHAPE.len()
        && name.bytes().zip(SHAPE).all(|(byte, shape)| match shape {
            b'0' => byte.is_ascii_digit(),
            other => byte == *other,
        })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn name(hour: u32) -> String {
        format!("2026-11-21T{hour:02}-00-00.000Z.mcap")
    }

    /// Makes a folder of logs of 1000 bytes that ended at these hours.
    fn folder(hours: std::ops::Range<u32>) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for hour in hours {
            let path = folder.path().join(name(hour));
            fs::write(&path, [0; 1000]).unwrap();
            File::open(path).unwrap().set_modified(at(hour)).unwrap();
        }
        folder
    }

    fn at(hour: u32) -> SystemTime {
        SystemTime::UNIX_EPOCH + Duration::from_hours(500_000 + u64::from(hour))
    }

    fn left(folder: &tempfile::TempDir) -> Vec<String> {
        let entries = fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> =
            entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn deletes_the_oldest_logs_above_the_maximum_size() {
        let folder = folder(0..6);
        let retention = Retention { max_bytes: 3500, max_age: None };
        let deleted = delete_old(folder.path(), retention, at(6)).unwrap();
        assert_eq!(deleted, Deleted { logs: 3, bytes: 3000 });
        assert_eq!(left(&folder), [name(3), name(4), name(5)]);
        let sentence = deleted.sentence(retention).unwrap();
        assert!(sentence.contains("the 3 oldest flight logs"), "{sentence}");
        let again = delete_old(folder.path(), retention, at(6)).unwrap();
        assert_eq!((again, again.sentence(retention)), (Deleted::default(), None));
    }

    #[test]
    fn old_logs_are_deleted_regardless_of_size() {
        let folder = folder(0..6);
        let retention = Retention { max_age: Some(Duration::from_hours(3)), ..Retention::FOREVER };
        assert_eq!(delete_old(folder.path(), retention, at(6)).unwrap().logs, 3);
        assert_eq!(left(&folder), [name(3), name(4), name(5)]);
        // With a clock earlier than the logs, none is old.
        assert_eq!(delete_old(folder.path(), retention, at(0)).unwrap().logs, 0);
    }

    #[test]
    fn keeps_open_and_renamed_logs_and_other_files() {
        let folder = folder(0..2);
        let kept = ["the best.mcap", "2026-11-21T04-09-21.123Z.answers.jsonl", "notes.txt"];
        for name in kept {
            fs::write(folder.path().join(name), [0; 9000]).unwrap();
        }
        fs::create_dir(folder.path().join(name(7))).unwrap();
        std::os::unix::fs::symlink("/etc/hostname", folder.path().join(name(8))).unwrap();
        let open = File::open(folder.path().join(name(0))).unwrap();
        open.lock().unwrap();
        let nothing = Retention { max_bytes: 0, max_age: Some(Duration::ZERO) };
        let deleted = delete_old(folder.path(), nothing, at(9)).unwrap();
        assert_eq!(deleted, Deleted { logs: 1, bytes: 1000 });
        assert_eq!(left(&folder).len(), kept.len() + 3);
        assert!(folder.path().join(name(0)).exists(), "locked");
        assert!(delete_old(Path::new("/no/such/folder"), nothing, at(0)).is_err());
    }

    #[test]
    fn recognises_names_of_logs() {
        assert!(is_log_name(&name(3)));
        assert!(is_log_name(&format!("{}.mcap", super::super::utc_name(SystemTime::now()))));
        for other in
            ["", "a.mcap", "2026-11-21T04-09-21.123Z.mcap2", "2026-11-21T04:09:21.123Z.mcap"]
        {
            assert!(!is_log_name(other), "{other}");
        }
    }
}
