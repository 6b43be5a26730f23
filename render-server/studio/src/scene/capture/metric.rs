//! Fourth stage: converts the largest model to metres and upright axes, with their uncertainty, and judges the capture.

mod ground;

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, ensure};
use glam::DVec3;
use serde::{Deserialize, Serialize};
use vizflyt_protocol::geometry::Intrinsics;
use vizflyt_tags::layout::{LayoutFrame, TagLayout};
use vizflyt_twin::adjust::{self, Adjusted, Capture, Options, Tag, TagSighting};
use vizflyt_twin::align::track::CameraPose;
use vizflyt_twin::align::{Fit, Similarity};
use vizflyt_twin::dataset::{SparseModel, colmap};
use vizflyt_twin::verdict::{self, Evidence, Given, Severity};

use self::ground::Ground;
use super::images::Pictures;
use super::poses::Poses;
use super::prints::Seen;
use super::work::Fingerprint;
use crate::scene::align::{self, ClockArgs};

/// Known data of the room and the camera.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct Room {
    /// Surveyed layout of the tags.
    pub(super) layout: Option<TagLayout>,
    /// Edge of all tags, if their positions are unknown. [m]
    pub(super) tag_size_m: Option<f64>,
    /// Measured distance between the centres of two tags.
    pub(super) length: Option<Length>,
    /// Motion capture track of the camera.
    pub(super) track: Option<Track>,
    /// Whether the lens was calibrated.
    pub(super) lens_is_known: bool,
}

/// Measured distance between the centres of two tags.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Length {
    pub(super) ids: [u32; 2],
    pub(super) metres: f64,
}

/// File with the motion capture track of the camera, and its clock options.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(super) struct Track {
    file: PathBuf,
    fingerprint: Fingerprint,
    clocks: ClockArgs,
}

impl Track {
    pub(super) fn of(file: &Path, clocks: &ClockArgs) -> Result<Self> {
        let fingerprint = Fingerprint::of(file)?;
        Ok(Self { file: file.to_owned(), fingerprint, clocks: clocks.clone() })
    }

    /// Estimates the placement of the adjusted cameras in the room.
    fn fit(&self, pictures: &Pictures, capture: &Capture, adjusted: &Adjusted) -> Result<Fit> {
        let names: Vec<&str> = capture.images.iter().map(|image| image.name.as_str()).collect();
        let times_s = if pictures.of_video {
            capture.images.iter().map(|image| image.at_s).collect()
        } else {
            align::track::times(&self.clocks, &pictures.folder, &names)?
        };
        let cameras = times_s.into_iter().zip(&adjusted.world_from_cam);
        let cameras = cameras.map(|(at_s, pose)| CameraPose {
            at_s,
            position: pose.translation_m,
            rotation: pose.rotation,
        });
        align::track::fit(
            &self.clocks,
            &self.file,
            cameras.collect(),
            &pictures.folder,
            TRACK_SIGMA_M,
        )
    }
}

/// Result of the stage, in addition to the model in `sparse/0`.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Metric {
    /// Whether a model was written.
    pub(super) has_model: bool,
    /// Source of the scale, in words.
    pub(super) scale_from: String,
    /// Whether the scale is guessed, because no measurement defines it.
    pub(super) scale_is_guessed: bool,
    /// Source of the vertical axis, in words.
    pub(super) up_from: String,
    /// Relative uncertainty of the scale, three sigmas.
    pub(super) scale_bound: Option<f64>,
    /// Uncertainty of the vertical axis, three sigmas. [degrees]
    pub(super) tilt_bound_deg: Option<f64>,
    /// Reprojection error of the points, root mean square. [px]
    pub(super) points_rms_px: Option<f64>,
    /// Rolling shutter of a video.
    #[serde(default)]
    pub(super) rolling_shutter: Option<RollingShutter>,
    pub(super) tags: Vec<TagFact>,
    pub(super) findings: Vec<FindingFact>,
    /// Results of the checks, one line each.
    pub(super) checked: Vec<String>,
    /// Whether no check rejects the capture.
    pub(super) fit_to_fly: bool,
    /// Placed pictures in order of time.
    pub(super) way: Vec<Placed>,
}

/// Pose of a placed picture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Placed {
    pub(super) name: String,
    pub(super) at_s: f64,
    /// [m, world]
    pub(super) position_m: DVec3,
    /// Viewing direction. [world]
    pub(super) ahead: DVec3,
}

/// Readout time of a rolling shutter.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RollingShutter {
    /// Time from the first to the last row; negative for a phone held upside down. [ms]
    pub(super) readout_ms: f64,
    /// Uncertainty, three sigmas. [ms]
    pub(super) bound_ms: f64,
}

impl RollingShutter {
    /// Returns the description for the report.
    pub(super) fn in_words(self) -> String {
        let Self { readout_ms, bound_ms } = self;
        if readout_ms.abs() <= bound_ms {
            return format!(
                "no rolling shutter: rows are exposed at the same time within {bound_ms:.1} ms (three sigmas)"
            );
        }
        let order = if readout_ms < 0.0 {
            "from the lowest to the uppermost"
        } else {
            "from the uppermost to the lowest"
        };
        format!(
            "rows are exposed one after the other, {order} over {:.1} ms, +- {bound_ms:.1} ms (three sigmas); poses are \
             those of the middle row",
            readout_ms.abs()
        )
    }
}

/// Fit of a tag.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct TagFact {
    pub(super) name: String,
    /// Centre; absent if too few pictures show the tag. [m, world]
    pub(super) position_m: Option<DVec3>,
    pub(super) sightings: usize,
    pub(super) contradicting: usize,
    /// Reprojection error of the corners. [px]
    pub(super) rms_px: Option<f64>,
    /// Distance between its surveyed position and its position estimated from the other tags. [m]
    pub(super) held_out_off_m: Option<f64>,
    /// Relative error of its edge length, estimated from the other tags.
    pub(super) held_out_size_error: Option<f64>,
}

/// Problem of a capture.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct FindingFact {
    pub(super) refused: bool,
    /// Whether only scale and vertical axis are affected, so that the images are still right.
    pub(super) of_metres: bool,
    pub(super) what: String,
    pub(super) remedy: String,
    /// First and last index of each affected run of pictures.
    pub(super) images: Vec<[usize; 2]>,
}

impl Metric {
    /// Returns a summary of one line.
    pub(super) fn summary(&self) -> String {
        if !self.has_model {
            return "not metric".to_owned();
        }
        let scale = self
            .scale_bound
            .map_or("guessed".to_owned(), |share| format!("to {:.2} %", 100.0 * share));
        let tilt =
            self.tilt_bound_deg.map_or("unknown".to_owned(), |deg| format!("to {deg:.2} degrees"));
        format!("scale {scale} by {}; up {tilt} by {}", self.scale_from, self.up_from)
    }

    /// Whether a scene trained from the model shows the room correctly, except for its scale.
    pub(super) fn is_fit_to_train(&self) -> bool {
        self.has_model && self.findings.iter().all(|f| !f.refused || f.of_metres)
    }
}

/// Converts the first model to metres, and judges the capture.
///
/// # Errors
/// A model cannot be read. Problems of the capture are findings, not errors.
pub(super) fn make(
    pictures: &Pictures,
    seen: &Seen,
    poses: &Poses,
    room: &Room,
    folder: &Path,
) -> Result<Metric> {
    if let Some(layout) = &room.layout {
        ensure!(
            layout.frame == LayoutFrame::World,
            "the layout of --tags is of tags on a vehicle (frame = \"body\"); give the layout of the room"
        );
    }
    let read = |folder: &Path| -> Result<SparseModel> {
        let mut model = colmap::read(folder)?;
        for image in &mut model.images {
            // The folder part of the names differs between programs.
            if let Some(name) = Path::new(&image.name).file_name().and_then(|name| name.to_str()) {
                image.name = name.to_owned();
            }
        }
        let is_ours = |name: &str| pictures.pictures.iter().any(|picture| picture.name == name);
        model.images.retain(|image| is_ours(&image.name));
        Ok(model)
    };
    let capture = |model: &SparseModel| -> Result<Capture> {
        let mut capture = Capture::new(model, |name| pictures.at_s(name))?;
        add_tags(&mut capture, pictures, seen, room);
        Ok(capture)
    };
    let model = read(&poses.models[0].folder)?;
    let first = capture(&model)
        .with_context(|| format!("the model in {}", poses.models[0].folder.display()))?;
    // Other models may be unreadable, or of other pictures.
    let others =
        poses.models[1..].iter().filter_map(|other| capture(&read(&other.folder).ok()?).ok());
    let others: Vec<Capture> = others.collect();
    let given: Vec<Given> = pictures
        .pictures
        .iter()
        .map(|picture| Given {
            name: picture.name.clone(),
            at_s: pictures.of_video.then_some(picture.at_s),
        })
        .collect();
    // Only videos have the times that a rolling shutter estimate needs.
    let options = Options {
        refine_lens: !room.lens_is_known,
        rolling: pictures.of_video,
        ..Options::default()
    };
    let adjusted = adjust::adjust(&first, options);
    let tracked = match (&room.track, &adjusted) {
        (Some(track), Ok(adjusted)) => Some(track.fit(pictures, &first, adjusted)?),
        _ => None,
    };
    let ground = adjusted.as_ref().ok().map(|adjusted| match tracked {
        Some(fit) => Ground::of_track(fit),
        None => Ground::of(&first, adjusted, seen, room),
    });
    let verdict = verdict::judge(&Evidence {
        given: &given,
        capture: &first,
        adjusted: adjusted.as_ref(),
        others: &others,
        aligned: ground.as_ref().and_then(|ground| ground.fit.as_ref()),
    });
    let mut metric = Metric { checked: verdict.checked.clone(), ..Metric::default() };
    metric.fit_to_fly = verdict.is_fit_to_fly();
    metric.findings = verdict.findings.iter().map(fact).collect();
    if let (Ok(adjusted), Some(ground)) = (&adjusted, &ground) {
        describe(&mut metric, &first, adjusted, ground);
        let metres = placed(&model, &first, adjusted, ground);
        colmap::write(&folder.join("sparse/0"), &metres)?;
        metric.has_model = true;
    }
    Ok(metric)
}

/// Adds the tags of known size or position, and their sightings.
fn add_tags(capture: &mut Capture, pictures: &Pictures, seen: &Seen, room: &Room) {
    let mut number = vec![None; seen.tags.len()];
    for (index, print) in seen.tags.iter().enumerate() {
        let surveyed = room.layout.as_ref().and_then(|layout| layout.find(print.family, print.id));
        let (size_m, corners_m) = match (surveyed, room.tag_size_m) {
            (Some(tag), _) => (tag.size_m, Some(tag.corners_m())),
            (None, Some(size_m)) => (size_m, None),
            (None, None) => continue,
        };
        number[index] = Some(capture.tags.len());
        let name = format!("{} {}", print.family.name(), print.id);
        capture.tags.push(Tag { name, size_m, corners_m });
    }
    for image in &mut capture.images {
        let place = pictures.pictures.iter().position(|picture| picture.name == image.name);
        let sightings = place.and_then(|place| seen.pictures.get(place));
        image.tags = sightings
            .into_iter()
            .flatten()
            .filter_map(|s| Some(TagSighting { tag: number[s.tag]?, corners_px: s.corners() }))
            .collect();
    }
}

fn fact(finding: &verdict::Finding) -> FindingFact {
    FindingFact {
        refused: finding.severity == Severity::Refused,
        of_metres: finding.check == verdict::Check::Metric,
        what: finding.what.clone(),
        remedy: finding.remedy.clone(),
        images: finding.images.iter().map(|run| [run.start, run.end.saturating_sub(1)]).collect(),
    }
}

fn describe(metric: &mut Metric, capture: &Capture, adjusted: &Adjusted, ground: &Ground) {
    metric.scale_from.clone_from(&ground.scale_from);
    metric.scale_is_guessed = ground.scale_is_guessed;
    metric.up_from.clone_from(&ground.up_from);
    let fit = ground.fit.as_ref();
    let scale_sigma = adjusted.scale_sigma.or(fit.map(|fit| fit.scale_sigma));
    metric.scale_bound = scale_sigma.filter(|_| !ground.scale_is_guessed).map(|sigma| 3.0 * sigma);
    let tilt_sigma_rad = adjusted.tilt_sigma_rad.or(fit.map(|fit| fit.tilt_sigma_rad));
    metric.tilt_bound_deg = tilt_sigma_rad.map(|sigma| (3.0 * sigma).to_degrees());
    metric.points_rms_px = Some(adjusted.points_rms_px);
    metric.rolling_shutter = adjusted.readout.map(|readout| RollingShutter {
        readout_ms: 1e3 * readout.seconds,
        bound_ms: 3e3 * readout.sigma_s,
    });
    for (tag, result) in capture.tags.iter().zip(&adjusted.tags) {
        let held_out = result.and_then(|result| result.held_out);
        metric.tags.push(TagFact {
            name: tag.name.clone(),
            position_m: result.map(|result| {
                ground.place.transform_point(result.corners_m.iter().sum::<DVec3>() / 4.0)
            }),
            sightings: result.map_or(0, |result| result.sightings),
            contradicting: result.map_or(0, |result| result.contradicting),
            rms_px: result.map(|result| result.rms_px),
            held_out_off_m: held_out.and_then(|held_out| held_out.off_m),
            held_out_size_error: held_out.map(|held_out| held_out.size_error),
        });
    }
    for (image, pose) in capture.images.iter().zip(&adjusted.world_from_cam) {
        let Similarity { rotation, .. } = ground.place;
        metric.way.push(Placed {
            name: image.name.clone(),
            at_s: image.at_s,
            position_m: ground.place.transform_point(pose.translation_m),
            ahead: rotation * (pose.rotation * DVec3::Z),
        });
    }
}

/// Returns the adjusted model in metres and upright axes.
fn placed(
    model: &SparseModel,
    capture: &Capture,
    adjusted: &Adjusted,
    ground: &Ground,
) -> SparseModel {
    let mut placed = model.clone();
    let lens: Intrinsics = adjusted.lens;
    for image in &mut placed.images {
        image.intrinsics = lens;
        let index = capture.images.iter().position(|of| of.name == image.name);
        if let Some(index) = index {
            let mut pose = adjusted.world_from_cam[index];
            pose.translation_m = ground.place.transform_point(pose.translation_m);
            pose.rotation = (ground.place.rotation * pose.rotation).normalize();
            image.world_from_cam = pose;
        }
    }
    // In order of their ids, as in the capture.
    let mut ids: Vec<u64> = placed.points.keys().copied().collect();
    ids.sort_unstable();
    for (id, &p_m) in ids.iter().zip(&adjusted.points_m) {
        if let Some(point) = placed.points.get_mut(id) {
            point.position = ground.place.transform_point(p_m);
        }
    }
    placed
}

/// Standard deviation of a motion capture and a hand-held marker. [m]
const TRACK_SIGMA_M: f64 = 0.005;
