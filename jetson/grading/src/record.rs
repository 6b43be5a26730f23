//! A flight that is over, as it lies on disk until the grade is made: so a grade that is interrupted goes on where
//! it was.
//!
//! It is sealed with a key that follows from the grading key and is nowhere on disk: a plugin that can write into the
//! report's folder makes no flight.

use std::collections::BTreeMap;

use anyhow::{Context, Result, ensure};
use ed25519_dalek::{Signature, Signer, SigningKey};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_trust::{from_hex, hex};

use super::document::{DelaysMs, Run, SignedFile, Subject, check_files};

/// What the first field holds; another layout is another number.
const FORMAT: &str = "vizflyt-flight-1";

/// What a flight depends on besides its seed and its variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlownWith {
    /// What the command line called the plugin: all built-in ones are the same file.
    pub plugin: String,
    /// SHA-256 over the plugin's files.
    pub plugin_sha256: String,
    /// The project's name.
    pub project: String,
    /// `ug` or `g`.
    pub level: String,
    /// What drawn variants are.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub environments: BTreeMap<String, EnvironmentConfig>,
    /// How long things took.
    pub delays: DelaysMs,
    /// The simulated inertial sensor; absent where it is the usual one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<String>,
    /// SHA-256 of this program's file.
    pub program_sha256: String,
    /// What rendered.
    pub renderer: String,
    /// What an answer may take of the plugin's own time. [s]
    pub answer_within_s: f64,
    /// Which images the log keeps.
    pub log: String,
}

impl FlownWith {
    /// Returns what flights of this grade depend on.
    pub fn new(subject: &Subject, answer_within_s: f64, log: &str) -> Self {
        let subject = subject.clone();
        Self {
            plugin: subject.plugin,
            plugin_sha256: subject.plugin_sha256,
            project: subject.project,
            level: subject.level,
            environments: subject.environments,
            delays: subject.delays,
            imu: subject.imu,
            program_sha256: subject.program_sha256,
            renderer: subject.renderer,
            answer_within_s,
            log: log.to_owned(),
        }
    }

    /// Returns what is another one there, for people.
    fn other(&self, there: &Self) -> Vec<&'static str> {
        let differs = [
            (
                "plugin",
                (&self.plugin, &self.plugin_sha256) != (&there.plugin, &there.plugin_sha256),
            ),
            ("project", self.project != there.project),
            ("level", self.level != there.level),
            ("drawn environments", self.environments != there.environments),
            ("time model", self.delays != there.delays),
            ("--imu", self.imu != there.imu),
            ("program", self.program_sha256 != there.program_sha256),
            ("instruction set", self.renderer != there.renderer),
            ("--answer-within", self.answer_within_s.to_bits() != there.answer_within_s.to_bits()),
            ("--log", self.log != there.log),
        ];
        differs.iter().filter(|(_, differs)| *differs).map(|(name, _)| *name).collect()
    }
}

/// A flight that is over.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightRecord {
    format: String,
    /// What it depends on.
    pub flown_with: FlownWith,
    /// How it went.
    pub run: Run,
    /// Its card, as HTML.
    pub card: String,
    /// Its images and its log.
    pub files: Vec<SignedFile>,
    /// Over all of the above, in hexadecimal (Ed25519).
    seal: String,
}

impl FlightRecord {
    /// Makes the record of a flight.
    pub fn new(flown_with: FlownWith, run: Run, card: String, files: Vec<SignedFile>) -> Self {
        Self { format: FORMAT.to_owned(), flown_with, run, card, files, seal: String::new() }
    }

    /// Returns its text, sealed.
    ///
    /// # Errors
    /// If it has no text: never, for numbers that are finite.
    pub fn to_text(&self, key: &SealingKey) -> Result<String> {
        let bare = Self { seal: String::new(), ..self.clone() };
        let seal = hex(&key.0.sign(&serde_json::to_vec(&bare)?).to_bytes());
        Ok(serde_json::to_string_pretty(&Self { seal, ..bare })? + "\n")
    }

    /// Reads a record that was sealed with `key` of a flight that depends on the same.
    ///
    /// # Errors
    /// Text that is no such record; which things are others.
    pub fn parse(text: &str, key: &SealingKey, flown_with: &FlownWith) -> Result<Self> {
        let record: Self = serde_json::from_str(text).context("it is no record of a flight")?;
        ensure!(record.format == FORMAT, "it is of the format {:?}", record.format);
        let bare = Self { seal: String::new(), ..record.clone() };
        let seal = from_hex::<64>(&record.seal).map(|bytes| Signature::from_bytes(&bytes));
        let bytes = serde_json::to_vec(&bare)?;
        ensure!(
            seal.is_some_and(|seal| key.0.verifying_key().verify_strict(&bytes, &seal).is_ok()),
            "it was changed after it was written, or another computer wrote it"
        );
        check_files(&record.files)?;
        let other = flown_with.other(&record.flown_with);
        ensure!(
            other.is_empty(),
            "it was flown with another {}: begin anew in another folder",
            other.join(", another ")
        );
        Ok(record)
    }
}

/// The key that records are sealed with.
pub struct SealingKey(SigningKey);

impl SealingKey {
    /// Returns the one that follows from a grading key; the other way nothing follows.
    pub fn of(grading: &SigningKey) -> Self {
        let mut hash = Sha256::new();
        hash.update(FORMAT);
        hash.update([0]);
        hash.update(grading.to_bytes());
        Self(SigningKey::from_bytes(&hash.finalize().into()))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use vizflyt_protocol::messages::OutcomeKind;

    use super::super::document::tests::{key, run, subject};
    use super::*;

    fn flown_with() -> FlownWith {
        FlownWith::new(&subject(), 10.0, "reduced")
    }

    fn record() -> FlightRecord {
        let files = [("images/day-1-00.jpg", 20), ("logs/day-1.mcap", 4_000_000)];
        let file = |(path, bytes): (&str, u64)| SignedFile {
            path: path.to_owned(),
            bytes,
            sha256: "66".repeat(32),
        };
        let card = "<section>\u{fffd}</section>".to_owned();
        let run = run(1, OutcomeKind::Collided);
        FlightRecord::new(flown_with(), run, card, files.map(file).to_vec())
    }

    #[test]
    fn a_record_comes_back_and_no_other_does() {
        let sealing = SealingKey::of(&key());
        let text = record().to_text(&sealing).unwrap();
        let read = FlightRecord::parse(&text, &sealing, &flown_with()).unwrap();
        let written = record();
        assert_eq!(
            (&read.run, &read.card, &read.files),
            (&written.run, &written.card, &written.files)
        );
        let refused = |text: &str, key: &SealingKey, with: &FlownWith, word: &str| {
            let error = format!("{:#}", FlightRecord::parse(text, key, with).unwrap_err());
            assert!(error.contains(word), "no {word:?} in {error:?}");
        };
        let other = SealingKey::of(&SigningKey::from_bytes(&[8; 32]));
        refused(&text, &other, &flown_with(), "another computer wrote it");
        let better = text.replacen("\"score\": 50.0", "\"score\": 100.0", 1);
        assert_ne!(better, text);
        refused(&better, &sealing, &flown_with(), "was changed after it was written");
        refused("{}", &sealing, &flown_with(), "no record of a flight");
        let with = FlownWith { plugin_sha256: "00".repeat(32), ..flown_with() };
        refused(&text, &sealing, &with, "with another plugin: begin anew");
        let with = FlownWith { plugin: "race".into(), ..flown_with() };
        refused(&text, &sealing, &with, "with another plugin: begin anew");
        let with = FlownWith { project: "p5".into(), log: "full".into(), ..flown_with() };
        refused(&text, &sealing, &with, "another project, another --log");
        // The grading key itself seals nothing.
        assert_ne!(sealing.0.to_bytes(), key().to_bytes());
    }

    proptest! {
        #[test]
        fn any_change_of_a_byte_is_noticed(at in any::<prop::sample::Index>(), byte in 32u8..127) {
            let sealing = SealingKey::of(&key());
            let text = record().to_text(&sealing).unwrap();
            let mut bytes = text.clone().into_bytes();
            let at = at.index(bytes.len());
            bytes[at] = byte;
            let Ok(changed) = String::from_utf8(bytes) else { return Ok(()) };
            let value = |text: &str| serde_json::from_str::<serde_json::Value>(text).ok();
            prop_assume!(value(&changed) != value(&text));
            prop_assert!(FlightRecord::parse(&changed, &sealing, &flown_with()).is_err());
        }
    }
}
