//! temp
use anyhow::Result;
use glam::DVec3;
use vizflyt_arena::ArenaConfig;
use vizflyt_protocol::geometry::Twist;
use vizflyt_protocol::messages::{EventKind, FlightPhase, PoseSample};
use vizflyt_protocol::time::ServerTime;
use vizflyt_splat::Splats;

use crate::drivers::Measurement;

pub struct Solid;
impl Solid {
    pub fn bake(_: &Splats, _: &ArenaConfig) -> Result<Self> {
        Ok(Self)
    }
    pub fn at(&self, _: DVec3) -> bool {
        false
    }
}
impl std::fmt::Display for Solid {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "none")
    }
}
pub struct Track {
    last: Option<Measurement>,
    lost: bool,
    events: Vec<(EventKind, String)>,
}
impl Track {
    pub fn new(_: &ArenaConfig, _: Solid) -> Self {
        Self { last: None, lost: false, events: Vec::new() }
    }
    pub fn restart(&mut self) {}
    pub fn phase(&mut self, _: FlightPhase) {}
    pub fn pose(&mut self, m: &Measurement) -> Option<PoseSample> {
        let v = self.last.map_or(DVec3::ZERO, |l| {
            (m.world_from_body.translation_m - l.world_from_body.translation_m)
                / m.stamp.seconds_since(l.stamp).max(1e-3)
        });
        self.last = Some(*m);
        if std::mem::take(&mut self.lost) {
            self.events.push((EventKind::PoseRegained, "poses are back".into()));
        }
        Some(PoseSample {
            stamp: m.stamp,
            world_from_body: m.world_from_body,
            twist: Twist { linear_mps: v, angular_radps: DVec3::ZERO },
            resets: 0,
        })
    }
    pub fn timeout(&mut self, now: ServerTime) {
        if let Some(l) = self.last {
            let age_s = now.seconds_since(l.arrival);
            if age_s > 0.5 && !self.lost {
                self.lost = true;
                self.events.push((EventKind::PoseLost { age_s }, "no pose for 500 ms".into()));
            }
        }
    }
    pub fn next_event(&mut self) -> Option<(EventKind, String)> {
        (!self.events.is_empty()).then(|| self.events.remove(0))
    }
}
