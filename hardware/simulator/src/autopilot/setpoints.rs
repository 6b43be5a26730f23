//! Handles SET_POSITION_TARGET_LOCAL_NED in GUIDED: accepted frames and masks, and setpoints that are dropped silently.

use glam::DVec3;
use vizflyt_protocol::geometry::yaw_of;
use vizflyt_protocol::mavlink::{
    CopterMode, GuidedMotion, UnsupportedSetpoint, dialect, guided_from_mavlink, ned_from_world,
};
use vizflyt_protocol::time::AutopilotTime;

use super::dialect::MavFrame;
use super::{Autopilot, Guided};

type Message = dialect::SET_POSITION_TARGET_LOCAL_NED_DATA;

impl Autopilot {
    pub(super) fn handle_setpoint(&mut self, now: AutopilotTime, m: &Message) {
        // Outside of GUIDED, and on the ground, ArduCopter drops setpoints silently.
        if self.mode != CopterMode::Guided || !self.armed || self.landed {
            return;
        }
        let Some(m) = self.in_local_frame(m.clone()) else { return };
        let setpoint = match guided_from_mavlink(&m) {
            Ok(setpoint) => setpoint,
            // An unsupported mask means stop. If one axis is ignored, its group is dropped; position with acceleration
            // but without velocity is also unsupported.
            Err(UnsupportedSetpoint::Mask(_)) => {
                let all = [m.x, m.y, m.z, m.vx, m.vy, m.vz, m.afx, m.afy, m.afz, m.yaw, m.yaw_rate];
                if all.iter().all(|value| value.is_finite()) {
                    self.guided = Guided::Hold;
                }
                return;
            }
            Err(_) => return,
        };
        let p_world_m = match setpoint.motion {
            GuidedMotion::Position(p) | GuidedMotion::PositionVelocity(p, _) => p,
            GuidedMotion::Velocity(_) | GuidedMotion::Acceleration(_) => DVec3::ZERO,
        };
        // A position beyond the fence is rejected. Velocities are accepted until the fence is breached.
        if matches!(setpoint.motion, GuidedMotion::Position(_)) && !self.is_within_fence(p_world_m)
        {
            return;
        }
        self.flight.yaw = setpoint.yaw;
        self.guided = Guided::Setpoint { setpoint, since: now, p_world_m };
    }

    /// Converts offsets and body axes to LOCAL_NED like ArduCopter: BODY_* frames are rotated by the heading, and
    /// positions in all frames except LOCAL_NED are relative to the vehicle. Returns `None` for other frames.
    fn in_local_frame(&self, mut m: Message) -> Option<Message> {
        let (turns, is_offset) = match m.coordinate_frame {
            MavFrame::MAV_FRAME_LOCAL_NED => (false, false),
            MavFrame::MAV_FRAME_LOCAL_OFFSET_NED => (false, true),
            MavFrame::MAV_FRAME_BODY_NED | MavFrame::MAV_FRAME_BODY_OFFSET_NED => (true, true),
            _ => return None,
        };
        let estimate = self.estimator.estimate();
        if turns {
            // Heading from north, clockwise.
            let yaw = std::f64::consts::FRAC_PI_2 - yaw_of(estimate.world_from_body);
            let (sin, cos) = (yaw.sin() as f32, yaw.cos() as f32);
            let turn = |x: &mut f32, y: &mut f32| {
                (*x, *y) = (*x * cos - *y * sin, *x * sin + *y * cos);
            };
            turn(&mut m.x, &mut m.y);
            turn(&mut m.vx, &mut m.vy);
            turn(&mut m.afx, &mut m.afy);
        }
        if is_offset {
            let here = ned_from_world(estimate.p_world_m);
            m.x += here.x as f32;
            m.y += here.y as f32;
            m.z += here.z as f32;
        }
        m.coordinate_frame = MavFrame::MAV_FRAME_LOCAL_NED;
        Some(m)
    }
}
