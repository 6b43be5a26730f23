//! Archives handed in by teams, as unpacked by `vizflyt grade-class`: no path leads out of a folder, and packing and
//! reading again gives the same files.
#![no_main]
use std::path::{Component, Path};

use libfuzzer_sys::fuzz_target;

use vizflyt_grading::class::archive::{MOST_BYTES, MOST_FILES, open, pack, without_outer_folder};

fuzz_target!(|bytes: &[u8]| {
    let Ok(files) = open(bytes) else { return };
    let total: u64 = files.values().map(|content| content.len() as u64).sum();
    assert!(files.len() <= MOST_FILES && total <= MOST_BYTES);
    for path in files.keys() {
        assert!(
            Path::new(path).components().all(|part| matches!(part, Component::Normal(_))),
            "{path}"
        );
    }
    if total < 1 << 20 {
        assert_eq!(open(&pack(&files).unwrap()).unwrap(), files);
    }
    let inner = without_outer_folder(files);
    assert!(inner.keys().all(|path| !path.is_empty() && !path.starts_with('/')));
});
