//! Record of a finished flight on disk, so that an interrupted grade can be resumed.
//!
//! The record is sealed with a key that is derived from the grading key and is not on disk: a
//! plugin that can write into the report's folder cannot forge a flight.

use std::collections::BTreeMap;

use anyhow::{Context, Result, ensure};
use ed25519_dalek::{Signature, Signer, SigningKey};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_arena::config::EnvironmentConfig;
use vizflyt_trust::{from_hex, hex};

use super::document::{DelaysMs, Run, SignedFile, Subject, check_files};

/// Value of the first field; a new layout gets a new number.
const FORMAT: &str = "vizflyt-flight-1";

/// All inputs of a flight except its seed and its variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlownWith {
    /// Name of the plugin on the command line: all built-in plugins are the same file.
    pub plugin: String,
    /// SHA-256 over the plugin's files.
    pub plugin_sha256: String,
    /// Name of the project.
    pub project: String,
    /// Level of the sensors: `ug` or `g`.
    pub level: String,
    /// Settings of random variants.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub environments: BTreeMap<String, EnvironmentConfig>,
    /// Name of the secret of the courses; absent if they are public.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub courses: Option<String>,
    /// Time model.
    pub delays: DelaysMs,
    /// Simulated inertial sensor; absent if it is the default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<String>,
    /// SHA-256 of this program's file.
    pub program_sha256: String,
    /// Renderer.
    pub renderer: String,
    /// Timeout of an answer, in the plugin's own time. [s]
    pub answer_within_s: f64,
    /// Images in the flight log.
    pub log: String,
}

impl FlownWith {
    /// Returns the inputs of the flights of this grade.
    pub fn new(subject: &Subject, answer_within_s: f64, log: &str) -> Self {
        let subject = subject.clone();
        Self {
            plugin: subject.plugin,
            plugin_sha256: subject.plugin_sha256,
            project: subject.project,
            level: subject.level,
            environments: subject.environments,
            courses: subject.courses,
            delays: subject.delays,
            imu: subject.imu,
            program_sha256: subject.program_sha256,
            renderer: subject.renderer,
            answer_within_s,
            log: log.to_owned(),
        }
    }

    /// Returns the names of the inputs that differ.
    fn other(&self, there: &Self) -> Vec<&'static str> {
        let differs = [
            (
                "plugin",
                (&self.plugin, &self.plugin_sha256) != (&there.plugin, &there.plugin_sha256),
            ),
            ("project", self.project != there.project),
            ("level", self.level != there.level),
            ("drawn environments", self.environments != there.environments),
            ("--secret", self.courses != there.courses),
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

/// A finished flight.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightRecord {
    format: String,
    /// Inputs of the flight.
    pub flown_with: FlownWith,
    /// Results of the flight.
    pub run: Run,
    /// Card as HTML.
    pub card: String,
    /// Images and log.
    pub files: Vec<SignedFile>,
    /// Signature over all other fields, in hexadecimal (Ed25519).
    seal: String,
}

impl FlightRecord {
    /// Makes the record of a flight.
    pub fn new(flown_with: FlownWith, run: Run, card: String, files: Vec<SignedFile>) -> Self {
        Self { format: FORMAT.to_owned(), flown_with, run, card, files, seal: String::new() }
    }

    /// Returns the sealed text.
    ///
    /// # Errors
    /// If the record has no JSON representation; cannot occur with finite numbers.
    pub fn to_text(&self, key: &SealingKey) -> Result<String> {
        let bare = Self { seal: String::new(), ..self.clone() };
        let seal = hex(&key.0.sign(&serde_json::to_vec(&bare)?).to_bytes());
        Ok(serde_json::to_string_pretty(&Self { seal, ..bare })? + "\n")
    }

    /// Parses a record that was sealed with `key`, of a flight with the same inputs.
    ///
    /// # Errors
    /// If the text is not such a record; the message names inputs that differ.
    pub fn parse(text: &str, key: &SealingKey, flown_with: &FlownWith) -> Result<Self> {
        let record: Self = serde_json::from_str(text).context("not a record of a flight")?;
        ensure!(record.format == FORMAT, "unsupported format {:?}", record.format);
        let bare = Self { seal: String::new(), ..record.clone() };
        let seal = from_hex::<64>(&record.seal).map(|bytes| Signature::from_bytes(&bytes));
        let bytes = serde_json::to_vec(&bare)?;
        ensure!(
            seal.is_some_and(|seal| key.0.verifying_key().verify_strict(&bytes, &seal).is_ok()),
            "the record was changed after it was written, or another computer wrote it"
        );
        check_files(&record.files)?;
        let other = flown_with.other(&record.flown_with);
        ensure!(
            other.is_empty(),
            "the flight was made with another {}: use another folder for a new grade",
            other.join(", another ")
        );
        Ok(record)
    }
}

/// Key that seals records.
pub struct SealingKey(SigningKey);

impl SealingKey {
    /// Derives the key from a grading key; the grading key cannot be derived from it.
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
    fn parses_its_own_records_and_rejects_others() {
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
        refused("{}", &sealing, &flown_with(), "not a record of a flight");
        let with = FlownWith { plugin_sha256: "00".repeat(32), ..flown_with() };
        refused(&text, &sealing, &with, "with another plugin: use another folder");
        let with = FlownWith { courses: Some("77".repeat(16)), ..flown_with() };
        refused(&text, &sealing, &with, "with another --secret: use another folder");
        let with = FlownWith { plugin: "race".into(), ..flown_with() };
        refused(&text, &sealing, &with, "with another plugin: use another folder");
        let with = FlownWith { project: "p5".into(), log: "full".into(), ..flown_with() };
        refused(&text, &sealing, &with, "another project, another --log");
        // The grading key itself does not seal records.
        assert_ne!(sealing.0.to_bytes(), key().to_bytes());
    }

    proptest! {
        #[test]
        fn detects_any_changed_byte(at in any::<prop::sample::Index>(), byte in 32u8..127) {
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
