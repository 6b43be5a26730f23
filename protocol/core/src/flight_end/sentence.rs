//! Titles and sentences for each reason. This is the only table of them.

use core::fmt;

use super::{Boundary, Collision, EndReason, FenceBreach, Missing, Obstacle, PluginFault};
use crate::copter_mode::CopterMode;

impl EndReason {
    /// Returns a short title for a headline.
    pub fn title(&self) -> &'static str {
        match self {
            Self::Finished { .. } => "Finished",
            Self::Collision(_) => "Collision",
            Self::Geofence(_) => "Left the geofence",
            Self::TimeLimit { .. } => "Time is up",
            Self::PoseLost { .. } => "Pose lost",
            Self::StopButton => "Stopped by hand",
            Self::LandButton | Self::Interrupted => "Landed by hand",
            Self::TimeAsked { .. } | Self::PluginLanded => "Landed",
            Self::Plugin(_) => "Plugin failed",
            _ => "Flight failed",
        }
    }
}

impl fmt::Display for EndReason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Finished { seconds } => write!(f, "finished after {seconds:.1} s"),
            Self::Collision(collision) => collision.fmt(f),
            Self::Geofence(breach) => breach.fmt(f),
            Self::TimeLimit { limit_s } => write!(f, "the course's {limit_s} s are over"),
            Self::PoseLost { age_s } => write!(f, "pose lost for {age_s:.1} s"),
            Self::StopButton => f.write_str("the stop button was pressed"),
            Self::LandButton => f.write_str("the land button was pressed"),
            Self::Interrupted => f.write_str("stopped by a person"),
            Self::TimeAsked { seconds } => write!(f, "the {seconds} s asked for are over"),
            Self::PluginLanded => f.write_str("the plugin asked to land"),
            Self::Plugin(fault) => fault.fmt(f),
            Self::NoImage => f.write_str("no image has come from the server"),
            Self::NotReady { within_s, missing } => {
                write!(f, "not in the air after {within_s:.0} s: {missing}")
            }
            Self::ClimbFailed { risen_m, within_s } => {
                write!(f, "take-off rose {risen_m:.2} m in {within_s} s, less than the target height")
            }
            Self::AutopilotRefused(words)
            | Self::ServerRefused(words)
            | Self::ArenaRefused(words) => f.write_str(words),
            Self::AutopilotSilent { silent_s } => {
                write!(f, "the autopilot has been silent for {silent_s} s")
            }
            Self::AutopilotRestarted => f.write_str("the autopilot restarted in flight"),
            Self::Disarmed => f.write_str("the vehicle disarmed in flight"),
            Self::TakenOver { mode } => match CopterMode::from_number(*mode) {
                Some(mode) => {
                    write!(f, "the autopilot was switched to {mode:?}, not by this runtime")
                }
                None => {
                    write!(f, "the autopilot was switched to mode {mode}, not by this runtime")
                }
            },
            Self::LeftInAir => f.write_str(
                "the vehicle is armed and in GUIDED without a companion; an earlier runtime left it in the air",
            ),
            Self::ArenaChanged { name } => {
                write!(f, "the server came back with another arena, {name}")
            }
            Self::NeverTookOff => f.write_str("the vehicle never took off"),
            Self::RecordEnds => f.write_str("the record ends before the flight"),
            Self::PoseUnsure { off_m } => write!(f, "the pose could be off by {off_m:.2} m"),
            Self::GuardianFailed => f.write_str("the guardian process failed"),
            Self::ImagesOld { age_s } => write!(f, "the plugin's images were {age_s:.1} s old"),
        }
    }
}

impl fmt::Display for Collision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { p_world_m: p, with, speed_mps, .. } = self;
        let (x, y, z) = (p.x, p.y, p.z);
        write!(f, "collision with {with} at ({x:.2}, {y:.2}, {z:.2}) m, at {speed_mps:.1} m/s")
    }
}

impl fmt::Display for Obstacle {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Scene => f.write_str("an obstacle"),
            Self::Floor => f.write_str("the floor"),
            Self::Object(name) => write!(f, "'{name}'"),
            Self::Vehicle(name) => write!(f, "vehicle '{name}'"),
            Self::Unseen => f.write_str("space that the capture has not seen"),
        }
    }
}

impl fmt::Display for FenceBreach {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { margin_m, boundary, speed_mps, overshoot_m, .. } = self;
        if *margin_m < 0.0 {
            return write!(f, "beyond {boundary} by {:.2} m", -margin_m);
        }
        write!(
            f,
            "cannot stop before {boundary}: {margin_m:.2} m left, and at {speed_mps:.1} m/s it would go \
             {overshoot_m:.2} m beyond"
        )
    }
}

impl fmt::Display for Boundary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Geofence => f.write_str("the geofence"),
            Self::Ceiling => f.write_str("the ceiling"),
            Self::NoFly(name) if name.is_empty() => f.write_str("a no-fly box"),
            Self::NoFly(name) => write!(f, "the no-fly box {name}"),
        }
    }
}

impl fmt::Display for PluginFault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ended(words) => f.write_str(words),
            Self::NotBack { within_s, why } => {
                write!(f, "the plugin did not come back within {within_s} s; {why}")
            }
            Self::NoAnswer { image, silent_s } => {
                write!(f, "the plugin has not answered image {image} for {silent_s:.1} s")
            }
            Self::NoSetpoint => f.write_str("the plugin answers images without a setpoint"),
            Self::Refused(fault) => write!(f, "the plugin's setpoints are refused: {fault}"),
        }
    }
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Server => "no answer from the server; check --server",
            Self::Plugin => "the plugin is not ready yet (`on_start` runs)",
            Self::Heartbeat => "no heartbeat from an autopilot; check power, link and --mavlink",
            Self::Disarmed => "the vehicle is armed already; disarm it first",
            Self::Pose => {
                "the server has no pose of the vehicle; check the localization and --vehicle"
            }
            Self::Answer => "the plugin has not answered an image yet",
            Self::PreArm(words)
            | Self::Connection(words)
            | Self::Images(words)
            | Self::Start(words) => words,
        })
    }
}
