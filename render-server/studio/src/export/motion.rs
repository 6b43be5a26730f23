//! Tracks of a flight: all data except pixels. They are read first, because images need the poses of their times.

use std::path::Path;

use anyhow::{Context, Result};
use glam::DVec3;
use vizflyt_protocol::geometry::{Body, Odom, Pose, World};
use vizflyt_runtime::log::data::{FlightData, FlightDatum, FlightImu, FlightMotion, StampedPose};
use vizflyt_runtime::log::read::LogReader;

/// Maximum time between two poses for interpolation. [ns]
const LONGEST_GAP_NS: u64 = 200_000_000;

/// Tracks of a flight, in order of time.
#[derive(Debug, Default)]
pub(super) struct FlightTracks {
    pub(super) poses: Vec<StampedPose<World>>,
    pub(super) motions: Vec<FlightMotion>,
    pub(super) imu: Vec<FlightImu>,
    pub(super) odometry: Vec<StampedPose<Odom>>,
    /// Requested setpoints, as JSON.
    pub(super) asked: Vec<(u64, Vec<u8>)>,
    pub(super) sent: Vec<(u64, Vec<u8>)>,
    /// Number of images.
    pub(super) images: usize,
    /// Number of observations with images, and of all observations.
    pub(super) with_images: usize,
    pub(super) observations: usize,
    /// Protocol of the log, if this version cannot read its images.
    pub(super) foreign_protocol: Option<u32>,
    pub(super) is_cut: bool,
}

/// Pose of the vehicle at an instant, from the filter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Interpolated {
    pub(super) world_from_body: Pose<World, Body>,
    /// Standard deviation of each axis; 0: unknown. [m, world], [rad, body]
    pub(super) position_sigma_m: DVec3,
    pub(super) rotation_sigma_rad: DVec3,
}

impl FlightTracks {
    /// Reads a log.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let context = || format!("cannot read {}", path.display());
        let mut data = FlightData::new(LogReader::open(path).with_context(context)?, false);
        let mut motion = Self::default();
        let mut seq = None;
        while let Some(datum) = data.next().with_context(context)? {
            match datum {
                FlightDatum::Image(image) => {
                    motion.images += 1;
                    // An observation can have an image of each camera.
                    if seq.replace(image.seq) != Some(image.seq) {
                        motion.with_images += 1;
                        motion.observations += 1;
                    }
                }
                FlightDatum::LeftOut => motion.observations += 1,
                FlightDatum::Foreign { protocol } => motion.foreign_protocol = Some(protocol),
                // Read in a separate pass, because readings of a LiDAR are larger than images.
                FlightDatum::Reading(_) => {}
                FlightDatum::Pose(pose) => motion.poses.push(pose),
                FlightDatum::Motion(one) => motion.motions.push(one),
                FlightDatum::Imu(reading) => motion.imu.push(reading),
                FlightDatum::Odometry(pose) => motion.odometry.push(pose),
                FlightDatum::Asked(at_ns, json) => motion.asked.push((at_ns, json)),
                FlightDatum::Sent(at_ns, json) => motion.sent.push((at_ns, json)),
            }
        }
        motion.is_cut = data.is_cut();
        // Two threads write the log, so entries can be slightly out of order.
        ascending(&mut motion.poses, |pose| pose.at_ns);
        ascending(&mut motion.motions, |one| one.at_ns);
        ascending(&mut motion.imu, |reading| reading.at_ns);
        ascending(&mut motion.odometry, |pose| pose.at_ns);
        motion.asked.sort_by_key(|(at_ns, _)| *at_ns);
        motion.sent.sort_by_key(|(at_ns, _)| *at_ns);
        Ok(motion)
    }

    /// Returns the time from the first to the last pose. [s]
    pub(super) fn seconds(&self) -> f64 {
        let ends = self.poses.first().zip(self.poses.last());
        ends.map_or(0.0, |(first, last)| (last.at_ns - first.at_ns) as f64 * 1e-9)
    }

    /// Returns the pose at an instant, interpolated between poses of the filter; `None` outside of them and in gaps.
    pub(super) fn at(&self, at_ns: u64) -> Option<Interpolated> {
        let next = self.poses.partition_point(|pose| pose.at_ns < at_ns);
        let b = self.poses.get(next)?;
        let a = if b.at_ns == at_ns { b } else { self.poses.get(next.checked_sub(1)?)? };
        let gap_ns = b.at_ns - a.at_ns;
        if gap_ns > LONGEST_GAP_NS {
            return None;
        }
        let share = if gap_ns == 0 { 0.0 } else { (at_ns - a.at_ns) as f64 / gap_ns as f64 };
        let sigma = self.motion_at(if share < 0.5 { a.at_ns } else { b.at_ns });
        Some(Interpolated {
            world_from_body: a.from_body.interpolate(&b.from_body, share),
            position_sigma_m: sigma.position_sigma_m,
            rotation_sigma_rad: sigma.rotation_sigma_rad,
        })
    }

    /// Returns velocity and sigmas at the time of a pose; zeros if they are unknown.
    pub(super) fn motion_at(&self, at_ns: u64) -> FlightMotion {
        let found = self.motions.binary_search_by_key(&at_ns, |one| one.at_ns);
        found.map_or(FlightMotion { at_ns, ..FlightMotion::default() }, |index| self.motions[index])
    }
}

fn ascending<T>(values: &mut Vec<T>, at_ns: impl Fn(&T) -> u64) {
    values.sort_by_key(&at_ns);
    values.dedup_by_key(|value| at_ns(value));
}

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;

    #[test]
    fn interpolates_poses_but_not_across_gaps() {
        let pose = |at_ns: u64| StampedPose {
            at_ns,
            from_body: Pose::new(
                DVec3::X * at_ns as f64 * 1e-9,
                DQuat::from_rotation_z(at_ns as f64 * 1e-9),
            ),
        };
        let sigma = DVec3::splat(0.01);
        let motions = vec![FlightMotion {
            at_ns: 10_000_000,
            position_sigma_m: sigma,
            ..FlightMotion::default()
        }];
        let poses = vec![pose(0), pose(10_000_000), pose(500_000_000)];
        let motion = FlightTracks { poses, motions, ..FlightTracks::default() };
        let at = motion.at(7_500_000).unwrap();
        assert!((at.world_from_body.translation_m.x - 0.0075).abs() < 1e-12);
        assert!(at.world_from_body.rotation.angle_between(DQuat::from_rotation_z(0.0075)) < 1e-9);
        assert_eq!(at.position_sigma_m, sigma, "of the nearer one");
        assert_eq!(motion.at(2_000_000).unwrap().position_sigma_m, DVec3::ZERO, "not known");
        assert!(motion.at(0).is_some() && motion.at(500_000_000).is_some());
        assert!(motion.at(20_000_000).is_none(), "half a second without a pose");
        assert!(motion.at(500_000_001).is_none());
    }
}
