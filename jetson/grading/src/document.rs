//! The grade as a document: subject, results of each flight, and a signature. The same plugin,
//! program, project and seeds give the same text, including the signature.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use anyhow::{Context, Result, bail, ensure};
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use vizflyt_arena::config::EnvironmentConfig;
pub(crate) use vizflyt_arena::points::PartPoints;
use vizflyt_arena::points::{Figures, PointsTable};
use vizflyt_arena::verdict::StageVerdict;
use vizflyt_protocol::messages::OutcomeKind;
use vizflyt_studio::shard::Shard;
use vizflyt_trust::{from_hex, hex};

use super::statistics::{Interval, mean_interval, share_interval};

/// Value of the first field; a new layout gets a new number.
pub(crate) const FORMAT: &str = "vizflyt-grade-1";

/// Maximum number of seeds, and of shards.
pub(crate) const MAX_SEEDS: u64 = 100_000;
/// Maximum number of variants, in this and later versions.
const MAX_VARIANTS: usize = 64;

/// A grade.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grade {
    /// [`FORMAT`].
    pub format: String,
    /// Hash over the hashes of the flights, in order.
    pub hash: String,
    /// Subject of the grade.
    pub subject: Subject,
    /// Shard of the flights; absent if the grade has all flights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shard: Option<Shard>,
    /// Results over all flights.
    pub summary: Summary,
    /// Points by the project's table; absent if it has none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub points: Vec<PartPoints>,
    /// Results of each variant, in order; absent if there is only one.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub by_variant: Vec<VariantSummary>,
    /// Flights, by variant and seed.
    pub runs: Vec<Run>,
    /// All other files in the report's folder, by path; empty without a report.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub files: Vec<SignedFile>,
    /// Signature over all other fields; absent before signing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub signature: Option<Signed>,
}

/// Subject of a grade: what was graded, and with what. Grades of the same subject can be compared
/// and merged.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Subject {
    /// Name of the plugin on the command line.
    pub plugin: String,
    /// SHA-256 over the plugin's files.
    pub plugin_sha256: String,
    /// Name of the team that handed the plugin in; absent if it was not given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub team: Option<String>,
    /// Name of the project.
    pub project: String,
    /// Level of the sensors: `ug` or `g`.
    pub level: String,
    /// Variants of light and weather, in order.
    pub variants: Vec<String>,
    /// Settings of random variants, in the format of an arena's `[environment]`.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub environments: BTreeMap<String, EnvironmentConfig>,
    /// First seed.
    pub first_seed: u64,
    /// Number of seeds of each variant.
    pub seeds: u64,
    /// Name of the secret of the courses, a hash that does not disclose it; absent if the courses are public.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub courses: Option<String>,
    /// Points table; absent if the project has none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub points: Option<PointsTable>,
    /// Time model.
    pub delays: DelaysMs,
    /// Simulated inertial sensor; absent if it is the default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub imu: Option<String>,
    /// Version of this program.
    pub program: String,
    /// SHA-256 of this program's file.
    pub program_sha256: String,
    /// Renderer, such as `cpu avx2`: other instruction sets round differently.
    pub renderer: String,
}

/// Time model: fixed delays of a graded flight. [ms]
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DelaysMs {
    /// Interval between images.
    pub image_period: f64,
    /// Age of an image on delivery to the plugin.
    pub image: f64,
    /// Delay from delivery until the plugin's answer takes effect.
    pub answer: f64,
}

/// Error of a flight's published estimate, after a least-squares alignment of origin and heading,
/// which the plugin may choose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OdometryScore {
    /// Number of compared estimates.
    pub poses: usize,
    /// Distance from the truth, root mean square. [m]
    pub ate_rmse_m: f64,
    /// Maximum distance from the truth. [m]
    pub ate_max_m: f64,
    /// Error of the motion in one second, root mean square; absent if the estimates cover less than
    /// that. [m]
    pub rpe_trans_rmse_m: Option<f64>,
    /// Error of the rotation in one second, root mean square. [deg]
    pub rpe_rot_rmse_deg: Option<f64>,
}

/// Results of one flight.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Run {
    /// Seed of the course and of the simulator's noise.
    pub seed: u64,
    /// Variant of light and weather.
    pub variant: String,
    pub outcome: OutcomeKind,
    /// Reason of the outcome, as a sentence.
    pub reason: String,
    /// Probable cause of the failure, in words; absent if the flight finished.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub cause: Option<String>,
    /// Number of stages passed.
    pub stages_passed: usize,
    /// Stages in order.
    pub stages: Vec<StageVerdict>,
    /// Time from take-off to the end. [s]
    pub seconds: f64,
    /// Time penalty. [s]
    pub penalty_s: f64,
    /// Score, 0 to 100.
    pub score: f64,
    /// Minimum distance from the body's surface to an obstacle. [m]
    pub min_clearance_m: Option<f64>,
    /// Maximum speed. [m/s]
    pub max_speed_mps: f64,
    /// Length of the flown path. [m]
    pub path_m: f64,
    /// Images that the plugin answered.
    pub images: u64,
    /// Error of the plugin's own estimate; absent if it published none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub odometry: Option<OdometryScore>,
    /// SHA-256 of the scene's splats.
    pub scene_sha256: String,
    /// SHA-256 of the rules, `arena.toml`.
    pub rules_sha256: String,
    /// SHA-256 over all samples, setpoints, events and images of the flight.
    pub hash: String,
}

/// A file of a report.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SignedFile {
    /// Path relative to the report's folder, with `/`.
    pub path: String,
    /// Size of the file. [bytes]
    pub bytes: u64,
    /// SHA-256 of the content.
    pub sha256: String,
}

/// Results over all flights.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Summary {
    /// Number of flights.
    pub runs: usize,
    /// Number of finished flights.
    pub finished: usize,
    /// Share of finished flights, 0 to 1, with its 95 % interval (Wilson).
    pub finish_share: Interval,
    /// Mean score, with its 95 % interval (bootstrap).
    pub score: Interval,
    /// Mean time of finished flights, penalties included. [s]
    pub mean_finish_s: Option<f64>,
    /// Mean number of stages passed.
    pub mean_stages_passed: f64,
    /// Minimum clearance of all flights. [m]
    pub min_clearance_m: Option<f64>,
}

/// Results over the flights of one variant.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VariantSummary {
    /// Variant of light and weather.
    pub variant: String,
    pub summary: Summary,
}

/// A signature (Ed25519, RFC 8032).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Signed {
    /// Public key, in hexadecimal.
    pub key: String,
    /// Signature over the grade's text without this field, in hexadecimal.
    pub signature: String,
}

impl Subject {
    /// Returns variant and seed of every flight, in order.
    pub fn flights(&self) -> impl Iterator<Item = (&str, u64)> {
        let seeds = self.seeds();
        self.variants
            .iter()
            .flat_map(move |variant| seeds.clone().map(move |seed| (variant.as_str(), seed)))
    }

    /// Returns the courses as words.
    pub fn courses(&self) -> String {
        match &self.courses {
            Some(name) => format!("secret, {name}"),
            None => "public: they follow from the seed".to_owned(),
        }
    }

    /// Returns the seeds of each variant.
    pub fn seeds(&self) -> Range<u64> {
        self.first_seed..self.first_seed.saturating_add(self.seeds)
    }
}

impl SignedFile {
    /// Returns the entry to sign for a file with this content.
    pub fn of(path: &str, bytes: &[u8]) -> Self {
        let sha256 = hex(&Sha256::digest(bytes));
        Self { path: path.to_owned(), bytes: bytes.len() as u64, sha256 }
    }
}

impl Grade {
    /// Makes an unsigned grade of these flights.
    pub fn new(subject: Subject, shard: Option<Shard>, mut runs: Vec<Run>) -> Self {
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
            points: points_of(&subject, &runs),
            by_variant: by_variant(&subject, &runs),
            subject,
            shard,
            runs,
            files: Vec::new(),
            signature: None,
        }
    }

    /// Signs the grade.
    pub fn sign(&mut self, key: &SigningKey) -> Result<()> {
        self.signature = None;
        let signature = key.sign(&self.bytes()?);
        self.signature = Some(Signed {
            key: hex(&key.verifying_key().to_bytes()),
            signature: hex(&signature.to_bytes()),
        });
        Ok(())
    }

    /// Checks the signature with `key`, and that the results follow from the flights.
    ///
    /// # Errors
    /// The first failed check, as a sentence.
    pub fn verify(&self, key: &VerifyingKey) -> Result<()> {
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
        ensure!(
            self.points == points_of(&self.subject, &self.runs),
            "the points do not follow from the flights"
        );
        // Earlier versions wrote no results of variants.
        ensure!(
            self.by_variant.is_empty() || self.by_variant == by_variant(&self.subject, &self.runs),
            "the figures of the variants do not follow from the flights"
        );
        Ok(())
    }

    /// Returns the median time of finished flights, penalties included. [s]
    pub fn median_finish_s(&self) -> Option<f64> {
        median_of_finished(&self.runs, |run| run.seconds + run.penalty_s)
    }

    /// Returns the points and the maximum; `None` if the project has no table.
    pub fn all_points(&self) -> Option<(f64, f64)> {
        let most = self.subject.points?.most();
        Some((millionth(self.points.iter().map(|part| part.points).sum()), millionth(most)))
    }

    /// Reads a grade from a file.
    ///
    /// # Errors
    /// If the file cannot be read, or is not a grade of this format.
    pub fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("{} is not a grade", path.display()))
    }

    /// Parses a grade.
    ///
    /// # Errors
    /// If the text is not a grade, or has more flights or shards than the maximum. Loops depend on
    /// these numbers before the signature is verified.
    pub fn parse(text: &str) -> Result<Self> {
        let grade: Self = serde_json::from_str(text)?;
        let Subject { seeds, variants, .. } = &grade.subject;
        ensure!(
            *seeds <= MAX_SEEDS && variants.len() <= MAX_VARIANTS,
            "{seeds} seeds in {} variants: at most {MAX_SEEDS} and {MAX_VARIANTS}",
            variants.len()
        );
        let points = grade.subject.points.as_ref();
        points.map_or(Ok(()), PointsTable::check).map_err(anyhow::Error::msg)?;
        if let Some(Shard { index, count }) = grade.shard {
            ensure!(Shard::is_one(index, count), "{index}/{count} is not a valid shard");
        }
        check_files(&grade.files)?;
        Ok(grade)
    }

    /// Returns the text for files.
    pub fn to_text(&self) -> Result<String> {
        Ok(serde_json::to_string_pretty(self)? + "\n")
    }

    /// Returns the signed bytes: the document without spaces, fields in the order of the type.
    fn bytes(&self) -> Result<Vec<u8>> {
        Ok(serde_json::to_vec(self)?)
    }
}

/// Checks that each path stays in the report's folder, and that the paths are sorted and unique.
///
/// # Errors
/// The first invalid path.
pub(crate) fn check_files(files: &[SignedFile]) -> Result<()> {
    for SignedFile { path, .. } in files {
        let is_inside = path.split('/').all(|part| !matches!(part, "" | "." | ".."));
        ensure!(is_inside && !path.contains('\0'), "{path:?} is not a valid path in a report");
    }
    let is_sorted = files.windows(2).all(|pair| pair[0].path < pair[1].path);
    ensure!(is_sorted, "the files are not sorted by path, each once");
    Ok(())
}

impl OdometryScore {
    /// Rounds the numbers to those of the text.
    pub fn round(&mut self) {
        let optional = self.rpe_trans_rmse_m.iter_mut().chain(&mut self.rpe_rot_rmse_deg);
        for number in [&mut self.ate_rmse_m, &mut self.ate_max_m].into_iter().chain(optional) {
            *number = millionth(*number);
        }
    }

    /// Returns the score as a sentence.
    pub fn text(&self) -> String {
        let relative = match (self.rpe_trans_rmse_m, self.rpe_rot_rmse_deg) {
            (Some(m), Some(deg)) => format!("; error per second of motion: {m:.3} m, {deg:.2} deg"),
            _ => String::new(),
        };
        format!(
            "its odometry was off by {:.3} m (rmse of {} poses, maximum {:.3}){relative}",
            self.ate_rmse_m, self.poses, self.ate_max_m
        )
    }
}

impl Run {
    /// Rounds every number to a millionth. Any JSON reader returns such numbers exactly, and the
    /// signature is over the text.
    pub fn round(&mut self) {
        let numbers = [&mut self.seconds, &mut self.penalty_s, &mut self.score];
        let others = [&mut self.max_speed_mps, &mut self.path_m].into_iter();
        let optional = self.stages.iter_mut().filter_map(|stage| stage.passed_s.as_mut());
        let optional = optional.chain(self.min_clearance_m.as_mut());
        for number in numbers.into_iter().chain(others).chain(optional) {
            *number = millionth(*number);
        }
        if let Some(odometry) = &mut self.odometry {
            odometry.round();
        }
    }
}

impl Summary {
    pub(super) fn of(runs: &[Run]) -> Self {
        let finished: Vec<&Run> = runs.iter().filter(|run| is_finished(run)).collect();
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
            min_clearance_m: least_clearance_m(runs.iter()),
        }
    }
}

fn is_finished(run: &Run) -> bool {
    run.outcome == OutcomeKind::Finished
}

fn least_clearance_m<'a>(runs: impl Iterator<Item = &'a Run>) -> Option<f64> {
    runs.filter_map(|run| run.min_clearance_m).reduce(f64::min)
}

/// Returns the median of a figure of the finished flights.
fn median_of_finished(runs: &[Run], figure: impl Fn(&Run) -> f64) -> Option<f64> {
    let finished = runs.iter().filter(|run| is_finished(run));
    let mut values: Vec<f64> = finished.map(figure).collect();
    values.sort_by(f64::total_cmp);
    let upper = *values.get(values.len() / 2)?;
    let lower = values[(values.len() - 1) / 2];
    Some(millionth(f64::midpoint(lower, upper)))
}

/// Returns the points of these flights, by the project's table.
fn points_of(subject: &Subject, runs: &[Run]) -> Vec<PartPoints> {
    let Some(table) = &subject.points else { return Vec::new() };
    let summary = Summary::of(runs);
    table.parts(&Figures {
        score: summary.score.value,
        time_s: summary.mean_finish_s,
        clearance_m: least_clearance_m(runs.iter().filter(|run| is_finished(run))),
        speed_mps: median_of_finished(runs, |run| run.max_speed_mps),
    })
}

/// Returns the results of each variant, if there are several.
fn by_variant(subject: &Subject, runs: &[Run]) -> Vec<VariantSummary> {
    if subject.variants.len() < 2 {
        return Vec::new();
    }
    let of = |variant: &String| {
        let runs: Vec<Run> = runs.iter().filter(|run| run.variant == *variant).cloned().collect();
        let summary = Summary::of(&runs);
        (!runs.is_empty()).then(|| VariantSummary { variant: variant.clone(), summary })
    };
    subject.variants.iter().filter_map(of).collect()
}

/// Returns the hash over the flights.
fn hash_of(runs: &[Run]) -> String {
    let mut hash = Sha256::new();
    for run in runs {
        // Lengths are fixed or included, so that different lists give different bytes.
        hash.update(run.seed.to_le_bytes());
        hash.update((run.variant.len() as u64).to_le_bytes());
        hash.update(run.variant.as_bytes());
        hash.update((run.hash.len() as u64).to_le_bytes());
        hash.update(run.hash.as_bytes());
    }
    hex(&hash.finalize())
}

/// Rounds to a millionth.
pub(super) fn millionth(number: f64) -> f64 {
    (number * 1e6).round() / 1e6
}

#[cfg(test)]
pub(crate) mod tests;
