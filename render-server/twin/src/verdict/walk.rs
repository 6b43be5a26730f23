//! Poses of a walk: adjusted, or those of structure from motion.

use std::collections::HashMap;
use std::ops::Range;

use glam::DVec3;
use vizflyt_protocol::geometry::{Cam, Intrinsics, Pose, World};

use super::{Evidence, Given, words};

/// Poses and points in one frame, with the indices of the images.
pub(super) struct Walk<'a> {
    pub(super) evidence: &'a Evidence<'a>,
    pub(super) lens: Intrinsics,
    pub(super) poses: Vec<Pose<World, Cam>>,
    pub(super) points: &'a [DVec3],
    /// Index of each image in the given images.
    pub(super) index: Vec<usize>,
    /// Lengths are in metres.
    pub(super) is_metric: bool,
}

impl<'a> Walk<'a> {
    pub(super) fn new(evidence: &'a Evidence<'a>) -> Self {
        let capture = evidence.capture;
        let number: HashMap<&str, usize> = evidence
            .given
            .iter()
            .enumerate()
            .map(|(index, given)| (given.name.as_str(), index))
            .collect();
        // An unknown image gets an index after all others.
        let find = |name: &str| number.get(name).copied().unwrap_or(evidence.given.len());
        let index = capture.images.iter().map(|image| find(&image.name)).collect();
        match evidence.adjusted {
            Ok(adjusted) => Self {
                evidence,
                lens: adjusted.lens,
                poses: adjusted.world_from_cam.clone(),
                points: &adjusted.points_m,
                index,
                is_metric: adjusted.known.scale,
            },
            Err(_) => Self {
                evidence,
                lens: capture.lens,
                poses: capture.images.iter().map(|image| image.scene_from_cam).collect(),
                points: &capture.points,
                index,
                is_metric: false,
            },
        }
    }

    /// Returns the walk with structure from motion's poses, in metres if the scale is known.
    pub(super) fn as_found(&self) -> Self {
        let evidence = self.evidence;
        let scale = match evidence.adjusted {
            Ok(adjusted) if self.is_metric => adjusted.world_from_scene.scale,
            _ => 1.0,
        };
        let poses = evidence.capture.images.iter().map(|image| {
            let pose = &image.scene_from_cam;
            Pose::new(pose.translation_m * scale, pose.rotation)
        });
        Self {
            evidence,
            lens: evidence.capture.lens,
            poses: poses.collect(),
            points: &evidence.capture.points,
            index: self.index.clone(),
            is_metric: self.is_metric,
        }
    }

    pub(super) fn given(&self) -> &'a [Given] {
        self.evidence.given
    }

    /// Returns the ranges of given images for images of the capture, in any order.
    pub(super) fn runs(&self, images: impl IntoIterator<Item = usize>) -> Vec<Range<usize>> {
        let mut given: Vec<usize> = images.into_iter().map(|image| self.index[image]).collect();
        given.retain(|index| *index < self.given().len());
        given.sort_unstable();
        given.dedup();
        words::runs(&given)
    }

    /// Formats ranges of images.
    pub(super) fn spans(&self, runs: &[Range<usize>]) -> String {
        words::spans(self.given(), runs)
    }
}
