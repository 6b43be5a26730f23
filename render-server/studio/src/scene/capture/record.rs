//! `capture.json`: record of a capture, with its accuracy.

use std::path::Path;

use anyhow::{Context, Result};
use glam::DVec3;
use serde::Serialize;
use vizflyt_twin::dataset::colmap;

use super::finish::Finished;
use super::images::Pictures;
use super::metric::Metric;
use super::page;
use super::poses::Poses;
use super::training::Trained;
use super::work::{Stage, StageTime, Work};

/// Record of a capture; results of stages that did not run are absent.
#[derive(Clone, Debug, Serialize)]
pub(super) struct Record {
    /// Format version: 1. It changes if a field changes its meaning.
    pub(super) version: u32,
    /// Program and version.
    pub(super) made_by: String,
    /// Path of the input.
    pub(super) source: String,
    /// Whether the twin can be flown.
    pub(super) fit_to_fly: bool,
    /// Error that stopped the capture.
    pub(super) failure: Option<Failure>,
    pub(super) stages: Vec<StageTime>,
    pub(super) remarks: Vec<String>,
    pub(super) pictures: Option<Pictures>,
    pub(super) poses: Option<Poses>,
    pub(super) metric: Option<Metric>,
    pub(super) trained: Option<Trained>,
    pub(super) finished: Option<Finished>,
}

/// Error that stopped a capture, and advice.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Failure {
    /// Stage of the error; absent if none had begun.
    pub(super) stage: Option<Stage>,
    pub(super) what: String,
    pub(super) remedy: String,
}

impl Failure {
    /// Describes an error, with advice for its stage.
    pub(super) fn new(error: &anyhow::Error, output: &Path, work: &Work) -> Self {
        let stage = work.running();
        let advice = match stage {
            None => "no stage was started: correct this, then run the same command again",
            Some(Stage::Images) => {
                "check that the video plays to its end, or give a folder of photos of one camera"
            }
            Some(Stage::Poses) => {
                "the output of the program is in stages/poses/log.txt; if it places too few pictures, film slowly, sideways past \
                 textured surfaces, with tags in view"
            }
            Some(Stage::Tags | Stage::Metric | Stage::Train | Stage::Finish) => {
                "correct this, then run the same command again"
            }
        };
        let mut remedy = advice.to_owned();
        if work.times().iter().any(|time| time.stage != Stage::Images) {
            remedy += "; completed stages are not run again";
        }
        if output.join("arena.toml").exists() {
            remedy += "; scene.ply and arena.toml in this folder are from an earlier run";
        }
        Self { stage, what: format!("{error:#}"), remedy }
    }
}

impl Record {
    /// Returns an empty record.
    pub(super) fn new(input: &Path) -> Self {
        Self {
            version: 1,
            made_by: format!("vizflyt {}", env!("CARGO_PKG_VERSION")),
            source: input.display().to_string(),
            fit_to_fly: false,
            failure: None,
            stages: Vec::new(),
            remarks: Vec::new(),
            pictures: None,
            poses: None,
            metric: None,
            trained: None,
            finished: None,
        }
    }

    /// Writes `capture.json` and `report.html`.
    pub(super) fn write(&mut self, output: &Path, work: &Work) -> Result<()> {
        let is_right = self.metric.as_ref().is_some_and(|metric| metric.fit_to_fly);
        let can_start = self.finished.as_ref().is_some_and(|f| f.findings.is_empty());
        self.fit_to_fly = is_right && can_start && self.failure.is_none();
        let points = self.points(work)?;
        let page = page::html(self, &points, &work.folder(Stage::Train));
        for (name, text) in
            [("capture.json", serde_json::to_string_pretty(self)? + "\n"), ("report.html", page)]
        {
            let path = output.join(name);
            std::fs::write(&path, text)
                .with_context(|| format!("cannot write {}", path.display()))?;
        }
        Ok(())
    }

    /// Returns the points of the metric model. [m, world]
    fn points(&self, work: &Work) -> Result<Vec<DVec3>> {
        if !self.metric.as_ref().is_some_and(|metric| metric.has_model) {
            return Ok(Vec::new());
        }
        let model = colmap::read(&work.folder(Stage::Metric).join("sparse/0"))?;
        let mut points: Vec<_> = model.points.into_iter().collect();
        points.sort_by_key(|(id, _)| *id);
        Ok(points.into_iter().map(|(_, point)| point.position).collect())
    }
}
