//! The newest motions of all vehicles, on their way from the pose thread to the render thread.

use vizflyt_arena::config::MAX_VEHICLES;
use vizflyt_arena::pose::Motion;
use vizflyt_protocol::messages::PoseSample;

use crate::mailbox::Mailbox;

/// The newest poses on their way to the render thread, by vehicle.
pub type NewestPoses = [Option<Localized>; MAX_VEHICLES];

/// Where a vehicle is, and whereto it moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Localized {
    /// The newest accepted pose.
    pub sample: PoseSample,
    /// How it moves by all that was read.
    pub motion: Motion,
}

impl Localized {
    /// Makes that of a vehicle that stands still.
    pub fn still(sample: PoseSample) -> Self {
        Self { sample, motion: Motion::at_rest(sample.stamp, sample.world_from_body) }
    }
}

/// Puts `accepted` where the render thread takes it from; what it has not taken yet of vehicles
/// without a new pose is still their newest.
pub fn publish(newest: &Mailbox<NewestPoses>, accepted: &NewestPoses) {
    newest.put_over(*accepted, |poses, older| {
        for (pose, older) in poses.iter_mut().zip(older) {
            *pose = pose.or(*older);
        }
    });
}

/// Takes the poses of `newer` into `poses`, where there are any.
pub fn merge(newer: &NewestPoses, poses: &mut NewestPoses) {
    for (pose, newer) in poses.iter_mut().zip(newer) {
        *pose = newer.or(*pose);
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::ServerTime;

    #[test]
    fn render_thread_gets_every_vehicles_newest_pose() {
        let poses = |at_ns: [Option<u64>; 3]| {
            let mut poses = NewestPoses::default();
            for (pose, at_ns) in poses.iter_mut().zip(at_ns) {
                *pose = at_ns.map(|ns| {
                    let stamp = ServerTime::from_ns(ns);
                    Localized::still(PoseSample::still(stamp, Pose::IDENTITY))
                });
            }
            poses
        };
        let stamps =
            |poses: &NewestPoses| poses.map(|pose| pose.map(|pose| pose.sample.stamp.as_ns()));
        let newest = Mailbox::default();
        publish(&newest, &poses([Some(1), Some(2), None]));
        publish(&newest, &poses([Some(3), None, None]));
        publish(&newest, &poses([None, None, Some(4)]));
        let mut taken = newest.take(Duration::ZERO).unwrap();
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(2), Some(4), None]);
        merge(&poses([None, Some(5), None]), &mut taken);
        assert_eq!(stamps(&taken)[..4], [Some(3), Some(5), Some(4), None]);
    }
}
