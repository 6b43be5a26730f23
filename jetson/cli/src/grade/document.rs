//! The grade as a document: what was graded, by what, how each flight went, and a signature over all
//! of it. The same plugin, program, project and seeds give the same text, signature included.

use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_arena::verdict::StageVerdict;
use vizflyt_protocol::messages::OutcomeKind;

use super::statistics::{Interval, mean_interval, share_interval};

/// What the first field holds; another layout is another number.
pub(crate) const FORMAT: &str = "vizflyt-grade-1";

/// Seeds that are flown at most, and parts of a grade.
pub(crate) const MOST_SEEDS: u64 = 100_000;
/// Variants that there are at most, in this version and those to come.
const MOST_VARIANTS: usize = 64;

/// A grade.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Grade {
    /// [`FORMAT`].
    pub format: String,
    /// Over the flights' hashes, in their order.
    pub hash: String,
    /// What was graded, and by what.
    pub subject: Subject,
    /// Which part of the flights this is; absent if all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shard: Option<Shard>,
    /// The figures over all flights.
    pub summary: Summary,
    /// The flights, by variant and seed.
    pub runs: Vec<Run>,
    /// Over all of the above; absent before it is signed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signature: Option<Signed>,
}

/// What was graded, and by what. Grades of the same subject can be compared and merged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Subject {
    /// What the command line called the plugin.
    pub plugin: String,
    /// SHA-256 over its files.
    pub plugin_sha256: String,
    /// The project's name.
    pub project: String,
    /// `ug` or `g`: which sensors it has.
    pub level: String,
    /// Variants of the surroundings that were flown, in order.
    pub variants: Vec<String>,
    /// The first seed.
    pub first_seed: u64,
    /// How many seeds each variant was flown with.
    pub seeds: u64,
    /// How long things took.
    pub delays: DelaysMs,
    /// Version of this program.
    pub program: String,
    /// SHA-256 of this program's file.
    pub program_sha256: String,
    /// What drew, such as `cpu avx2`: another instruction set rounds differently.
    pub renderer: String,
}

/// The time model. [ms]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DelaysMs {
    /// From one image to the next.
    pub image_period: f64,
    /// Age of an image when the plugin gets it.
    pub image: f64,
    /// From then until its answer counts.
    pub answer: f64,
}

/// A part of the flights.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Shard {
    /// From 1.
    pub index: u64,
    /// How many there are.
    pub count: u64,
}

/// One flight.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Run {
    /// Of the place and of the simulator's noise.
    pub seed: u64,
    /// The surroundings.
    pub variant: String,
    /// How it ended.
    pub outcome: OutcomeKind,
    /// Why, in one sentence.
    pub reason: String,
    /// What it probably was, in words; absent if it finished.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cause: Option<String>,
    /// How many stages were passed.
    pub stages_passed: usize,
    /// The stages in order.
    pub stages: Vec<StageVerdict>,
    /// From take-off to the end. [s]
    pub seconds: f64,
    /// Added for offences. [s]
    pub penalty_s: f64,
    /// 0 to 100.
    pub score: f64,
    /// Least distance of the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
    /// [m/s]
    pub max_speed_mps: f64,
    /// Way flown. [m]
    pub path_m: f64,
    /// Images that the plugin answered.
    pub images: u64,
    /// SHA-256 of the place: its splats.
    pub scene_sha256: String,
    /// SHA-256 of its rules: `arena.toml`.
    pub rules_sha256: String,
    /// SHA-256 over all samples, setpoints, events and images of the flight.
    pub hash: String,
}

/// The figures over all flights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Summary {
    /// Flights.
    pub runs: usize,
    /// Those that finished.
    pub finished: usize,
    /// Share of flights that finish, 0 to 1, with its 95 % interval (Wilson).
    pub finish_share: Interval,
    /// Mean score, with its 95 % interval (bootstrap).
    pub score: Interval,
    /// Mean time of the flights that finished, penalties included. [s]
    pub mean_finish_s: Option<f64>,
    /// Mean of the stages passed.
    pub mean_stages_passed: f64,
    /// Least clearance of all flights. [m]
    pub min_clearance_m: Option<f64>,
}

/// A signature (Ed25519, RFC 8032).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Signed {
    /// The public key, in hexadecimal.
    pub key: String,
    /// Over the grade's text without this field, in hexadecimal.
    pub signature: String,
}

impl Subject {
    /// Returns variant and seed of every flight, in their order.
    pub(crate) fn flights(&self) -> impl Iterator<Item = (&str, u64)> {
        let seeds = self.first_seed..self.first_seed.saturating_add(self.seeds);
        self.variants
            .iter()
            .flat_map(move |variant| seeds.clone().map(move |seed| (variant.as_str(), seed)))
    }
}

impl Shard {
    /// Whether there is such a part.
    fn is_one(index: u64, count: u64) -> bool {
        1 <= index && index <= count && count <= MOST_SEEDS
    }

    /// Whether the flight at this place of the order belongs to it.
    pub(crate) fn holds(self, place: usize) -> bool {
        place as u64 % self.count == self.index - 1
    }
}

impl std::str::FromStr for Shard {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parts = text.split_once('/').and_then(|(index, count)| {
            let (index, count) = (index.parse().ok()?, count.parse().ok()?);
            Self::is_one(index, count).then_some(Self { index, count })
        });
        parts.ok_or_else(|| format!("{text:?} is no part; give 1/4 to 4/4 for four parts"))
    }
}

impl Grade {
    /// Makes an unsigned grade of these flights.
    pub(crate) fn new(subject: Subject, shard: Option<Shard>, mut runs: Vec<Run>) -> Self {
        let order = |run: &Run| {
            let variant = subject.variants.iter().position(|variant| *variant == run.variant);
            (variant.unwrap_or(usize::MAX), run.seed)
        };
        runs.sort_by_key(order);
        runs.iter_mut().for_each(Run::round);
        Self {
            format: FORMAT.to_owned(),
            hash: hash_of(&runs),
            summary: Summary::of(&runs),
            subject,
            shard,
            runs,
            signature: None,
        }
    }

    /// Signs it.
    pub(crate) fn sign(&mut self, key: &SigningKey) -> Result<()> {
        self.signature = None;
        let signature = key.sign(&self.bytes()?);
        self.signature = Some(Signed {
            key: hex(&key.verifying_key().to_bytes()),
            signature: hex(&signature.to_bytes()),
        });
        Ok(())
    }

    /// Checks that the grade is as it was signed with `key`, and that its figures follow from its
    /// flights.
    ///
    /// # Errors
    /// What does not hold, in a sentence.
    pub(crate) fn verify(&self, key: &VerifyingKey) -> Result<()> {
        let Some(signed) = &self.signature else { bail!("the grade is not signed") };
        let public = hex(&key.to_bytes());
        ensure!(
            signed.key == public,
            "the grade is signed with the key {}, not with {public}",
            signed.key
        );
        let Some(signature) = from_hex::<64>(&signed.signature) else {
            bail!("the grade's signature is not 128 hexadecimal digits");
        };
        let bare = Self { signature: None, ..self.clone() };
        key.verify_strict(&bare.bytes()?, &Signature::from_bytes(&signature))
            .ok()
            .context("the grade was changed after it was signed")?;
        ensure!(self.format == FORMAT, "the grade is of the format {}", self.format);
        ensure!(self.hash == hash_of(&self.runs), "the grade's hash is not that of its flights");
        ensure!(
            self.summary == Summary::of(&self.runs),
            "the summary does not follow from the flights"
        );
        Ok(())
    }

    /// Returns the median time of the flights that finished, penalties included. [s]
    pub(crate) fn median_finish_s(&self) -> Option<f64> {
        let finished = self.runs.iter().filter(|run| run.outcome == OutcomeKind::Finished);
        let mut times: Vec<f64> = finished.map(|run| run.seconds + run.penalty_s).collect();
        times.sort_by(f64::total_cmp);
        let upper = *times.get(times.len() / 2)?;
        let lower = times[(times.len() - 1) / 2];
        Some(millionth(f64::midpoint(lower, upper)))
    }

    /// Reads a grade from a file.
    ///
    /// # Errors
    /// If it cannot be read or is no grade of this format.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("{} is no grade", path.display()))
    }

    /// Reads a grade from its text.
    ///
    /// # Errors
    /// Text that is no grade, or one of more flights or parts than are ever flown: what it says is
    /// counted through, also before its signature holds.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        let grade: Self = serde_json::from_str(text)?;
        let Subject { seeds, variants, .. } = &grade.subject;
        ensure!(
            *seeds <= MOST_SEEDS && variants.len() <= MOST_VARIANTS,
            "{seeds} seeds in {} variants: at most {MOST_SEEDS} and {MOST_VARIANTS}",
            variants.len()
        );
        if let Some(Shard { index, count }) = grade.shard {
            ensure!(Shard::is_one(index, count), "{index}/{count} is no part");
        }
        Ok(grade)
    }

    /// Returns the text for files and people.
    pub(crate) fn to_text(&self) -> Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }

    /// Returns what is signed: the document without spaces, its fields in the order of the type.
    fn bytes(&self) -> Result<Vec<u8>> {
        Ok(serde_json::to_vec(self)?)
    }
}

impl Run {
    /// Rounds every number to a millionth: such numbers come back from any reader of JSON to the last
    /// bit, and the signature is over the text.
    fn round(&mut self) {
        let numbers = [&mut self.seconds, &mut self.penalty_s, &mut self.score];
        let others = [&mut self.max_speed_mps, &mut self.path_m].into_iter();
        let optional = self.stages.iter_mut().filter_map(|stage| stage.passed_s.as_mut());
        let optional = optional.chain(self.min_clearance_m.as_mut());
        for number in numbers.into_iter().chain(others).chain(optional) {
            *number = millionth(*number);
        }
    }
}

impl Summary {
    fn of(runs: &[Run]) -> Self {
        let finished: Vec<&Run> =
            runs.iter().filter(|run| run.outcome == OutcomeKind::Finished).collect();
        let scores: Vec<f64> = runs.iter().map(|run| run.score).collect();
        let stages: usize = runs.iter().map(|run| run.stages_passed).sum();
        let times = finished.iter().map(|run| run.seconds + run.penalty_s);
        let rounded = |found: Interval| Interval {
            value: millionth(found.value),
            low: millionth(found.low),
            high: millionth(found.high),
        };
        Self {
            runs: runs.len(),
            finished: finished.len(),
            finish_share: rounded(share_interval(finished.len(), runs.len())),
            score: rounded(mean_interval(&scores)),
            mean_finish_s: (!finished.is_empty())
                .then(|| millionth(times.sum::<f64>() / finished.len() as f64)),
            mean_stages_passed: millionth(stages as f64 / runs.len().max(1) as f64),
            min_clearance_m: runs.iter().filter_map(|run| run.min_clearance_m).reduce(f64::min),
        }
    }
}

/// Returns the hash over the flights.
fn hash_of(runs: &[Run]) -> String {
    let mut hash = Sha256::new();
    for run in runs {
        // Lengths are fixed or told, so that no two lists give the same bytes.
        hash.update(run.seed.to_le_bytes());
        hash.update((run.variant.len() as u64).to_le_bytes());
        hash.update(run.variant.as_bytes());
        hash.update((run.hash.len() as u64).to_le_bytes());
        hash.update(run.hash.as_bytes());
    }
    hex(&hash.finalize())
}

/// Rounds to a millionth.
fn millionth(number: f64) -> f64 {
    (number * 1e6).round() / 1e6
}

/// Returns bytes in hexadecimal.
pub(crate) fn hex(bytes: &[u8]) -> String {
    use std::fmt::Write;
    bytes.iter().fold(String::with_capacity(2 * bytes.len()), |mut text, byte| {
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Returns `N` bytes from hexadecimal as [`hex`] writes it, in small letters: there is one text for
/// each signature, and none beside it counts; `None` if it is anything else.
pub(crate) fn from_hex<const N: usize>(text: &str) -> Option<[u8; N]> {
    let digits = text.as_bytes();
    let is_digit = |digit: &u8| matches!(digit, b'0'..=b'9' | b'a'..=b'f');
    if digits.len() != 2 * N || !digits.iter().all(is_digit) {
        return None;
    }
    let mut bytes = [0; N];
    for (byte, pair) in bytes.iter_mut().zip(text.as_bytes().chunks_exact(2)) {
        *byte = u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()?;
    }
    Some(bytes)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;
    use serde_json::Value;

    pub(crate) fn subject() -> Subject {
        Subject {
            plugin: "avoid".into(),
            plugin_sha256: "11".repeat(32),
            project: "forest".into(),
            level: "ug".into(),
            variants: vec!["day".into()],
            first_seed: 1,
            seeds: 4,
            delays: DelaysMs { image_period: 33.3, image: 30.0, answer: 10.0 },
            program: "0.1.0".into(),
            program_sha256: "22".repeat(32),
            renderer: "cpu avx2".into(),
        }
    }

    pub(crate) fn run(seed: u64, outcome: OutcomeKind) -> Run {
        Run {
            seed,
            variant: "day".into(),
            outcome,
            reason: "reached the goal".into(),
            cause: (outcome != OutcomeKind::Finished).then(|| "too fast".to_owned()),
            stages_passed: 1,
            stages: vec![StageVerdict { name: "window".into(), passed_s: Some(3.25) }],
            seconds: 10.0 + 0.1 * seed as f64,
            penalty_s: 0.5,
            score: if outcome == OutcomeKind::Finished { 100.0 } else { 50.0 },
            min_clearance_m: Some(0.31),
            max_speed_mps: 2.9,
            path_m: 21.7,
            images: 300,
            scene_sha256: "33".repeat(32),
            rules_sha256: "44".repeat(32),
            hash: "55".repeat(32),
        }
    }

    pub(crate) fn key() -> SigningKey {
        SigningKey::from_bytes(&[7; 32])
    }

    pub(crate) fn grade() -> Grade {
        let runs = vec![run(3, OutcomeKind::Finished), run(1, OutcomeKind::Collided)];
        let shard = Some(Shard { index: 1, count: 2 });
        let mut grade = Grade::new(subject(), shard, runs);
        grade.sign(&key()).unwrap();
        grade
    }

    #[test]
    fn a_signed_grade_is_verified_also_after_it_was_written_and_read() {
        let grade = grade();
        assert_eq!(grade.runs.iter().map(|run| run.seed).collect::<Vec<_>>(), [1, 3]);
        grade.verify(&key().verifying_key()).unwrap();
        let read = Grade::parse(&grade.to_text().unwrap()).unwrap();
        assert_eq!(read, grade);
        read.verify(&key().verifying_key()).unwrap();
        let other = SigningKey::from_bytes(&[8; 32]).verifying_key();
        assert!(read.verify(&other).unwrap_err().to_string().contains("is signed with the key"));
    }

    /// Returns the paths of all values in a document that are not containers.
    fn leaves(value: &Value, path: &str, found: &mut Vec<String>) {
        match value {
            Value::Object(fields) => {
                fields.iter().for_each(|(key, v)| leaves(v, &format!("{path}/{key}"), found));
            }
            Value::Array(items) => {
                items
                    .iter()
                    .enumerate()
                    .for_each(|(i, v)| leaves(v, &format!("{path}/{i}"), found));
            }
            _ => found.push(path.to_owned()),
        }
    }

    fn is_refused(document: &Value) -> bool {
        let Ok(grade) = Grade::parse(&document.to_string()) else { return true };
        grade.verify(&key().verifying_key()).is_err()
    }

    #[test]
    fn every_field_is_protected() {
        let document: Value = serde_json::from_str(&grade().to_text().unwrap()).unwrap();
        let mut paths = Vec::new();
        leaves(&document, "", &mut paths);
        assert!(!is_refused(&document) && paths.len() > 60, "{}", paths.len());
        for path in &paths {
            let mut changed = document.clone();
            let value = changed.pointer_mut(path).unwrap();
            *value = match value {
                Value::String(text) if text == "finished" => "collided".into(),
                Value::String(text) if text == "collided" => "finished".into(),
                Value::String(text) => {
                    let mut digits = text.clone().into_bytes();
                    let last = digits.last_mut().unwrap();
                    *last = if *last == b'1' { b'2' } else { b'1' };
                    String::from_utf8(digits).unwrap().into()
                }
                Value::Number(number) if number.is_f64() => (number.as_f64().unwrap() + 0.5).into(),
                Value::Number(number) => (number.as_u64().unwrap() + 1).into(),
                other => panic!("{path} holds {other}"),
            };
            assert!(is_refused(&changed), "{path} can be changed");
        }
    }

    #[test]
    fn flights_are_neither_left_out_nor_added_nor_is_anything_else() {
        let document: Value = serde_json::from_str(&grade().to_text().unwrap()).unwrap();
        let mut fewer = document.clone();
        fewer["runs"].as_array_mut().unwrap().pop();
        assert!(is_refused(&fewer));
        let mut more = document.clone();
        let run = more["runs"][0].clone();
        more["runs"].as_array_mut().unwrap().push(run);
        assert!(is_refused(&more));
        for path in ["", "/subject", "/summary", "/runs/0", "/signature", "/shard"] {
            let mut added = document.clone();
            let place = added.pointer_mut(path).unwrap().as_object_mut().unwrap();
            place.insert("bonus".into(), 1.into());
            assert!(is_refused(&added), "{path:?} takes another field");
        }
        for field in ["shard", "signature"] {
            let mut without = document.clone();
            without.as_object_mut().unwrap().remove(field);
            assert!(is_refused(&without), "{field} can go");
        }
    }

    #[test]
    fn shards_hold_every_flight_once() {
        let subject = Subject { variants: vec!["day".into(), "night".into()], ..subject() };
        let flights: Vec<_> = subject.flights().collect();
        assert_eq!((flights.len(), flights[0], flights[7]), (8, ("day", 1), ("night", 4)));
        let shards: Vec<Shard> = ["1/3", "2/3", "3/3"].map(|text| text.parse().unwrap()).to_vec();
        for place in 0..flights.len() {
            assert_eq!(shards.iter().filter(|shard| shard.holds(place)).count(), 1);
        }
        for wrong in ["1/100001", "0/3", "4/3", "1/0", "1", "a/b", "-1/2"] {
            assert!(wrong.parse::<Shard>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_median_is_of_the_flights_that_finished() {
        let of = |outcomes: &[OutcomeKind]| {
            let runs = outcomes.iter().zip(1..).map(|(&outcome, seed)| run(seed, outcome));
            Grade::new(subject(), None, runs.collect()).median_finish_s()
        };
        // Seed n takes 10.5 s and n tenths, penalty included.
        let (done, hit) = (OutcomeKind::Finished, OutcomeKind::Collided);
        assert_eq!(of(&[hit, hit]), None);
        assert_eq!(of(&[hit, done]), Some(10.7));
        assert_eq!(of(&[done, done, hit, done]), Some(10.7));
        assert_eq!(of(&[done, done]), Some(10.65));
    }

    #[test]
    fn numbers_that_would_be_counted_for_ever_make_no_grade() {
        let parsed = |change: &dyn Fn(&mut Grade)| {
            let mut grade = grade();
            change(&mut grade);
            Grade::parse(&grade.to_text().unwrap())
        };
        assert!(parsed(&|_| ()).is_ok());
        for wrong in [Shard { index: 1, count: u64::MAX }, Shard { index: 0, count: 0 }] {
            let error = parsed(&|grade| grade.shard = Some(wrong)).unwrap_err().to_string();
            assert!(error.ends_with("is no part"), "{error}");
        }
        let error = parsed(&|grade| grade.subject.seeds = u64::MAX).unwrap_err().to_string();
        assert!(error.contains("at most 100000"), "{error}");
        assert!(parsed(&|grade| grade.subject.variants = vec!["day".into(); 65]).is_err());
    }

    #[test]
    fn hexadecimal_comes_back_and_nonsense_does_not() {
        assert_eq!(from_hex::<2>(&hex(&[0xab, 0x01])), Some([0xab, 0x01]));
        for text in ["", "abc", "abcg", "+bcd", "äb", "AB01"] {
            assert_eq!(from_hex::<2>(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn any_change_of_a_byte_is_noticed(at in 0usize..4000, byte in 32u8..127) {
            let text = grade().to_text().unwrap();
            let mut bytes = text.clone().into_bytes();
            let at = at % bytes.len();
            bytes[at] = byte;
            let changed = String::from_utf8(bytes).unwrap();
            let same = |text: &str| serde_json::from_str::<Value>(text).ok();
            // Other spaces, or another way to write the same number, are no change.
            prop_assume!(same(&changed) != same(&text));
            let refused = Grade::parse(&changed)
                .is_ok_and(|grade| grade == super::tests::grade())
                || Grade::parse(&changed)
                    .map_or(true, |grade| grade.verify(&key().verifying_key()).is_err());
            prop_assert!(refused);
        }
    }
}
