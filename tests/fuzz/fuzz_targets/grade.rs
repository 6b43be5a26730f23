//! Grades, as `vizflyt grade verify` and `merge` read them: nothing counts that was not signed as it is.
#![no_main]
use ed25519_dalek::SigningKey;
use libfuzzer_sys::fuzz_target;

// The command line is a program, no library: its parser is compiled in here.
#[path = "../../../jetson/cli/src/grade"]
#[allow(dead_code)]
mod grade {
    pub(crate) mod document;
    pub(crate) mod merge;
    mod statistics;
}
use grade::document::Grade;
use grade::merge::merge;

fuzz_target!(|text: &str| {
    let Ok(read) = Grade::parse(text) else { return };
    let key = SigningKey::from_bytes(&[7; 32]);
    // Nobody has our key: what comes from outside does not count.
    let public = SigningKey::from_bytes(&[8; 32]).verifying_key();
    assert!(read.verify(&public).is_err());
    let mut own = Grade::new(read.subject.clone(), read.shard, read.runs.clone());
    own.sign(&key).unwrap();
    own.verify(&key.verifying_key()).unwrap();
    let _ = own.median_finish_s();
    // With another hash it does not count, however it is spelt.
    let mut changed = own.clone();
    changed.hash.push('0');
    assert!(changed.verify(&key.verifying_key()).is_err());
    // Parts: a grade merges alone or reports why not, and never with itself.
    let name = || "grade".to_owned();
    if let Ok(whole) = merge(&[(name(), own.clone())], &key.verifying_key()) {
        assert_eq!(whole.runs.len(), own.runs.len());
    }
    assert!(merge(&[(name(), own.clone()), (name(), own)], &key.verifying_key()).is_err());
});
