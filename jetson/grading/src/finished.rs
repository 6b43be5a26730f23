//! Finished flights: written into the report's folder when they end, and kept for `--resume`.

use std::collections::{BTreeSet, HashMap};

use anyhow::{Context, Result, bail, ensure};
use vizflyt_process::print_error;
use vizflyt_scenes::Variant;
use vizflyt_studio::course::CourseInstance;

use super::args::FlyArgs;
use super::document::{Run, SignedFile};
use super::folder::{self, FLIGHTS, ReportFolder};
use super::record::{FlightRecord, FlownWith, SealingKey};
use super::trial::TrialResult;
use super::{check_outputs, keys, report};

/// A finished and judged flight.
#[derive(Clone)]
pub(super) struct FlightDone {
    pub(super) run: Run,
    /// Card as HTML; empty without a report.
    pub(super) card: String,
    /// Files of the flight in the report.
    pub(super) files: Vec<SignedFile>,
    /// Virtual time flown in this run; 0 if the flight is from an interrupted grade. [s]
    pub(super) virtual_s: f64,
}

impl FlightDone {
    pub(super) fn of(mut run: Run) -> Self {
        // Rounded here, so that memory and the signed text agree.
        run.round();
        Self { run, card: String::new(), files: Vec::new(), virtual_s: 0.0 }
    }
}

/// The report while flights are in progress.
pub(super) struct LiveReport {
    pub(super) folder: ReportFolder,
    flown_with: FlownWith,
    key: SealingKey,
    /// Finished flights of the interrupted grade.
    kept: HashMap<(String, u64), FlightDone>,
}

impl LiveReport {
    /// Opens the report's folder, if a report is requested.
    pub(super) fn open(
        args: &FlyArgs,
        flown_with: FlownWith,
        flights: &[(Variant, u64)],
    ) -> Result<Option<Self>> {
        let Some(root) = &args.report else { return Ok(None) };
        check_outputs(Some(root), &args.result, args.junit.as_deref())?;
        let folder =
            if args.resume { ReportFolder::resume(root)? } else { ReportFolder::begin(root)? };
        // The grading key itself is not held until the last plugin has ended.
        let key = SealingKey::of(&keys::signing_key(args.result.keys.as_deref())?);
        let mut report = Self { folder, flown_with, key, kept: HashMap::new() };
        let mut there = BTreeSet::new();
        for (variant, seed) in flights.iter().filter(|_| args.resume) {
            let path = format!("{FLIGHTS}/{variant}-{seed}.json");
            let text = match std::fs::read_to_string(report.folder.at(&path)) {
                Err(error) if error.kind() == std::io::ErrorKind::NotFound => continue,
                text => text.with_context(|| format!("cannot read {path}"))?,
            };
            let done = report.read(&path, &text, *variant, *seed);
            let done = done
                .with_context(|| format!("{} cannot be kept", report.folder.at(&path).display()))?;
            there.extend(done.files.iter().map(|file| file.path.clone()));
            report.kept.insert((variant.to_string(), *seed), done);
        }
        let other: Vec<String> =
            report.folder.records()?.into_iter().filter(|path| !there.contains(path)).collect();
        ensure!(
            other.is_empty(),
            "{} contains flights that were not requested ({}): give the same seeds, \
             variants and part, or another folder",
            root.display(),
            folder::list(&other)
        );
        report.folder.keep_only(&there)?;
        if !report.kept.is_empty() {
            print_error(format_args!(
                "{} of {} flights are finished already and kept",
                report.kept.len(),
                flights.len()
            ));
        }
        Ok(Some(report))
    }

    fn read(&self, path: &str, text: &str, variant: Variant, seed: u64) -> Result<FlightDone> {
        let record = FlightRecord::parse(text, &self.key, &self.flown_with)?;
        let (run, card, mut files) = (record.run, record.card, record.files);
        if (&*run.variant, run.seed) != (&*variant.to_string(), seed) {
            bail!("the file is the record of seed {}, {}", run.seed, run.variant);
        }
        self.folder.check(&files)?;
        files.push(SignedFile::of(path, text.as_bytes()));
        Ok(FlightDone { card, files, ..FlightDone::of(run) })
    }

    /// Returns a finished flight of the interrupted grade.
    pub(super) fn kept(&self, variant: Variant, seed: u64) -> Option<FlightDone> {
        self.kept.get(&(variant.to_string(), seed)).cloned()
    }

    /// Writes images, log and then the record of a flight, each flushed to disk.
    pub(super) fn write(
        &self,
        course: &CourseInstance,
        flown: &TrialResult,
        log: Option<&std::fs::File>,
        done: &mut FlightDone,
    ) -> Result<()> {
        let (folder, run) = (&self.folder, &done.run);
        let CourseInstance { arena, field, .. } = course;
        let has_log = log.is_some();
        let (card, mut files) = report::card::write(folder, arena, field, run, flown, has_log)?;
        if let Some(log) = log {
            files.push(folder.write_file(&report::card::log_path(run), log)?);
        }
        let files = folder::sorted(files);
        let with = self.flown_with.clone();
        let record = FlightRecord::new(with, run.clone(), card.clone(), files.clone());
        let path = format!("{FLIGHTS}/{}.json", report::card::name(run));
        let record = folder.write(&path, record.to_text(&self.key)?.as_bytes())?;
        (done.card, done.files) = (card, files);
        done.files.push(record);
        Ok(())
    }
}
