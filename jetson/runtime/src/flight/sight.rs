//! Age of the images that the plugin uses.
//!
//! The age of an image is the age of the pose from which it was rendered. Before take-off, images must be frequent and
//! fresh ([`MIN_IMAGE_RATE_HZ`], [`MAX_IMAGE_AGE_S`]). In flight, the guard reduces the speed by the age of the image
//! of the plugin's last reply.

use std::collections::VecDeque;

use vizflyt_protocol::messages::{ArenaInfo, MAX_CAMERAS};
use vizflyt_protocol::time::HostTime;

/// Measurement time of the pose behind each camera's image in an observation; `None` for a camera without an image.
/// [host]
pub type Views = [Option<HostTime>; MAX_CAMERAS];

/// Minimum number of images in the last second before take-off. [1/s]
pub const MIN_IMAGE_RATE_HZ: usize = 4;
/// Maximum median age of these images on arrival at the plugin. [s]
pub const MAX_IMAGE_AGE_S: f64 = 0.25;

/// Maximum number of observations that wait for a reply; the oldest are dropped.
const MAX_SHOWN: usize = 64;

/// Images that were shown to the plugin, and that it has replied to.
#[derive(Debug, Default)]
pub(super) struct Sight {
    /// Cameras that the plugin needs, each of which must be fresh; empty: one fresh camera is enough.
    used: Vec<usize>,
    /// Observations without a reply, oldest first.
    shown: VecDeque<(u64, Views)>,
    /// Newest image of each camera that reached the plugin.
    newest: Views,
    /// Newest image of each camera with a reply.
    answered: Views,
    /// Observations of the last second: time of arrival, and age. [s]
    arrivals: VecDeque<(HostTime, f64)>,
}

impl Sight {
    /// Sets the cameras that the plugin needs, by name.
    ///
    /// # Errors
    /// Returns a sentence if the arena has no such camera.
    pub(super) fn use_cameras(
        &mut self,
        names: &[String],
        arena: &ArenaInfo,
    ) -> Result<(), String> {
        let find = |name: &String| {
            let index = arena.cameras.iter().position(|camera| camera.name.as_str() == name);
            index.ok_or_else(|| {
                let there: Vec<&str> =
                    arena.cameras.iter().map(|camera| camera.name.as_str()).collect();
                let there = there.join(", ");
                format!("[plugin] cameras: this arena has no camera {name}; it has {there}")
            })
        };
        self.used = names.iter().map(find).collect::<Result<_, _>>()?;
        Ok(())
    }

    /// Records that observation `seq` is shown to the plugin at `now`.
    pub(super) fn shown(&mut self, now: HostTime, seq: u64, views: &Views) {
        if self.shown.len() == MAX_SHOWN {
            self.shown.pop_front();
        }
        self.shown.push_back((seq, *views));
        keep_newest(&mut self.newest, views);
        if let Some(at) = self.instant(&self.newest) {
            self.arrivals.push_back((now, now.seconds_since(at)));
        }
        self.forget_arrivals(now);
    }

    /// Records the plugin's reply to observation `seq`.
    pub(super) fn answered(&mut self, seq: u64) {
        while let Some((_, views)) = self.shown.pop_front_if(|(shown, _)| *shown <= seq) {
            keep_newest(&mut self.answered, &views);
        }
    }

    /// Returns the measurement time of the pose behind the image of the plugin's last reply. [host]
    pub(super) fn answered_at(&self) -> Option<HostTime> {
        self.instant(&self.answered)
    }

    /// Returns why the images do not allow a take-off; `None` if they do.
    pub(super) fn why_unfit(&mut self, now: HostTime) -> Option<String> {
        self.forget_arrivals(now);
        let rate_hz = self.arrivals.len();
        if rate_hz < MIN_IMAGE_RATE_HZ {
            return Some(format!(
                "{rate_hz} images came in the last second; take-off needs {MIN_IMAGE_RATE_HZ}"
            ));
        }
        let mut ages_s: Vec<f64> = self.arrivals.iter().map(|&(_, age_s)| age_s).collect();
        ages_s.sort_by(f64::total_cmp);
        let median_s = ages_s[ages_s.len() / 2];
        (median_s > MAX_IMAGE_AGE_S).then(|| {
            format!(
                "images are {:.0} ms old when they come; take-off allows {:.0}",
                median_s * 1e3,
                MAX_IMAGE_AGE_S * 1e3
            )
        })
    }

    fn forget_arrivals(&mut self, now: HostTime) {
        while self.arrivals.pop_front_if(|(at, _)| now.seconds_since(*at) > 1.0).is_some() {}
    }

    /// Returns the relevant time of these cameras: the newest, or the oldest of the cameras in use.
    fn instant(&self, views: &Views) -> Option<HostTime> {
        if self.used.is_empty() {
            return views.iter().flatten().max().copied();
        }
        // None if one of them has no image yet.
        let used: Option<Vec<HostTime>> = self.used.iter().map(|&camera| views[camera]).collect();
        used?.into_iter().min()
    }
}

fn keep_newest(newest: &mut Views, views: &Views) {
    for (newest, view) in newest.iter_mut().zip(views) {
        *newest = (*newest).max(*view);
    }
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::geometry::{Intrinsics, Volume};
    use vizflyt_protocol::messages::{CameraInfo, Limits};
    use vizflyt_sdk::glam::DVec3;

    use super::*;

    fn ms(ms: u64) -> HostTime {
        HostTime::from_ns(10_000_000_000 + ms * 1_000_000)
    }

    fn view(camera: usize, at: HostTime) -> Views {
        let mut views = Views::default();
        views[camera] = Some(at);
        views
    }

    fn using(names: &[&str]) -> Result<Sight, String> {
        let net = Volume::aabb(DVec3::splat(-5.0), DVec3::splat(5.0));
        let mut arena = ArenaInfo::new("test", net, Limits::new(3.0, 5.0));
        for name in ["front", "down"] {
            let intrinsics = Intrinsics::from_horizontal_fov(8, 6, 1.5);
            let _ = arena.cameras.push(CameraInfo::forward(name, intrinsics));
        }
        let names: Vec<String> = names.iter().map(|&name| name.to_owned()).collect();
        let mut sight = Sight::default();
        sight.use_cameras(&names, &arena)?;
        Ok(sight)
    }

    #[test]
    fn uses_the_pose_behind_the_last_reply() {
        let mut sight = Sight::default();
        assert_eq!(sight.answered_at(), None);
        for seq in 1..=5 {
            sight.shown(ms(seq * 30 + 20), seq, &view(0, ms(seq * 30)));
        }
        assert_eq!(sight.answered_at(), None, "only images with a reply count");
        sight.answered(3);
        assert_eq!(sight.answered_at(), Some(ms(90)));
        sight.answered(2);
        assert_eq!(sight.answered_at(), Some(ms(90)), "an old reply changes nothing");
        sight.answered(9);
        assert_eq!(sight.answered_at(), Some(ms(150)));
    }

    #[test]
    fn take_off_needs_frequent_and_fresh_images() {
        let unfit = |period_ms: u64, age_ms: u64| {
            let mut sight = Sight::default();
            for seq in 1..=100 {
                let at = seq * period_ms;
                sight.shown(ms(at + age_ms), seq, &view(0, ms(at)));
            }
            sight.why_unfit(ms(100 * period_ms + age_ms))
        };
        for (period_ms, age_ms) in [(8, 15), (33, 30), (200, 30), (240, 240)] {
            assert_eq!(unfit(period_ms, age_ms), None, "{period_ms} {age_ms}");
        }
        let few = unfit(400, 30).unwrap();
        assert_eq!(few, "3 images came in the last second; take-off needs 4");
        let old = unfit(33, 300).unwrap();
        assert_eq!(old, "images are 300 ms old when they come; take-off allows 250");
        assert!(Sight::default().why_unfit(ms(0)).is_some(), "nothing has come");
    }

    #[test]
    fn every_camera_in_use_must_be_fresh() {
        let error = using(&["left"]).unwrap_err();
        assert_eq!(error, "[plugin] cameras: this arena has no camera left; it has front, down");
        for (names, expected) in [
            (&[][..], Some(ms(100))),
            (&["front"], Some(ms(100))),
            (&["down"], Some(ms(40))),
            (&["front", "down"], Some(ms(40))),
        ] {
            let mut sight = using(names).unwrap();
            sight.shown(ms(50), 1, &view(1, ms(40)));
            sight.shown(ms(110), 2, &view(0, ms(100)));
            sight.answered(2);
            assert_eq!(sight.answered_at(), expected, "{names:?}");
        }
        let mut sight = using(&["front", "down"]).unwrap();
        sight.shown(ms(110), 1, &view(0, ms(100)));
        sight.answered(1);
        assert_eq!(sight.answered_at(), None, "the other camera has never come");
        assert!(sight.why_unfit(ms(110)).unwrap().starts_with("0 images"));
    }
}
