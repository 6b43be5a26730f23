//! Test of a log on a full disk, simulated by the process's limit of file sizes. A separate test binary,
//! because the limit applies to the complete process.

use nix::sys::resource::{Resource, setrlimit};
use vizflyt_runtime::log::read::{Entry, LogReader};
use vizflyt_runtime::log::{Channel, FlightLog, LogSettings, keep_going_when_files_are_full};
use vizflyt_sdk::host_now;

/// Maximum file size. [bytes]
const ROOM: u64 = 3 << 20;

#[test]
fn full_disk_leaves_a_valid_file_and_a_running_process() {
    keep_going_when_files_are_full();
    let folder = tempfile::tempdir().unwrap();
    let log = FlightLog::open(&LogSettings::full(folder.path()), None);
    let path = log.path().unwrap().to_owned();
    setrlimit(Resource::RLIMIT_FSIZE, ROOM, ROOM).unwrap();
    let line = serde_json::json!({"text": "x".repeat(100_000)});
    let mut written = 0;
    let trouble = loop {
        log.write(Channel::Requested, host_now(), &line);
        written += 1;
        // Chunks are written at least each second; this limit ends a hanging test.
        assert!(written < 1_000_000, "the disk is never full");
        if let Some(trouble) = log.poll_trouble()
            && trouble.contains("not logged any further")
        {
            break trouble;
        }
    };
    // Further records do not block.
    log.write(Channel::Requested, host_now(), &line);
    drop(log);
    let len = std::fs::metadata(&path).unwrap().len();
    assert!(len <= ROOM, "{len} bytes");
    let bytes = std::fs::read(&path).unwrap();
    let strict = mcap::MessageStream::new(&bytes).unwrap();
    assert!(strict.into_iter().all(|message| message.is_ok()), "{trouble}");
    let mut reader = LogReader::open(&path).unwrap();
    let mut found = 0;
    while let Some(entry) = reader.next().unwrap() {
        found += u64::from(matches!(entry, Entry::Message(_)));
    }
    assert!(!reader.is_cut(), "a complete file");
    println!("{found} messages of {len} bytes are left: {trouble}");
}
