//! Grades as read by `vizflyt grade verify` and `merge`, and flight records as read by `--resume`: only unchanged
//! signed data is valid.
#![no_main]
use std::collections::BTreeMap;

use ed25519_dalek::SigningKey;
use libfuzzer_sys::fuzz_target;

use vizflyt_grading::document::{DelaysMs, Grade};
use vizflyt_grading::merge::merge;
use vizflyt_grading::record::{FlightRecord, FlownWith, SealingKey};

/// Checks a flight record: only an unchanged record with our own key is valid.
fn record(text: &str, read: &Grade) {
    let sealing = |byte| SealingKey::of(&SigningKey::from_bytes(&[byte; 32]));
    let (own, other) = (sealing(7), sealing(8));
    let with = FlownWith::new(&read.subject, 10.0, "reduced");
    let Some(run) = read.runs.first() else { return };
    let mut run = run.clone();
    run.round();
    let record = FlightRecord::new(with.clone(), run, text.to_owned(), read.files.clone());
    let sealed = record.to_text(&own).unwrap();
    assert!(FlightRecord::parse(&sealed, &other, &with).is_err());
    // Values beyond all limits cannot be written as text.
    if let Ok(found) = FlightRecord::parse(&sealed, &own, &with) {
        assert_eq!((&found.run, &found.card), (&record.run, &record.card));
    }
}

fuzz_target!(|text: &str| {
    let key = SealingKey::of(&SigningKey::from_bytes(&[7; 32]));
    let with = FlownWith {
        plugin: String::new(),
        plugin_sha256: String::new(),
        project: String::new(),
        level: String::new(),
        courses: None,
        environments: BTreeMap::new(),
        delays: DelaysMs { image_period: 33.3, image: 30.0, answer: 10.0 },
        imu: None,
        program_sha256: String::new(),
        renderer: String::new(),
        answer_within_s: 10.0,
        log: String::new(),
    };
    assert!(FlightRecord::parse(text, &key, &with).is_err());
    let Ok(read) = Grade::parse(text) else { return };
    record(text, &read);
    let key = SigningKey::from_bytes(&[7; 32]);
    // Data from outside is never signed with our key.
    let public = SigningKey::from_bytes(&[8; 32]).verifying_key();
    assert!(read.verify(&public).is_err());
    let mut own = Grade::new(read.subject.clone(), read.shard, read.runs.clone());
    own.files.clone_from(&read.files);
    own.sign(&key).unwrap();
    own.verify(&key.verifying_key()).unwrap();
    let _ = own.median_finish_s();
    // A changed hash is never valid.
    let mut changed = own.clone();
    changed.hash.push('0');
    assert!(changed.verify(&key.verifying_key()).is_err());
    // A complete grade can be merged on its own or gives an error, and never together with itself.
    let name = || "grade".to_owned();
    if let Ok(whole) = merge(&[(name(), own.clone())], &key.verifying_key()) {
        assert_eq!(whole.runs.len(), own.runs.len());
    }
    assert!(merge(&[(name(), own.clone()), (name(), own)], &key.verifying_key()).is_err());
});
