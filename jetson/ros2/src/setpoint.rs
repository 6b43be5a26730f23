//! Converts commands from ROS 2 to setpoints: velocities with a deadline, paths, and landing. Pure: commands and times
//! in.

use std::fmt;

use thiserror::Error;
use vizflyt_sdk::{Axes, Path as FlownPath, PathYaw, Setpoint, Trajectory, Waypoint, YawTarget};

use crate::convert::Frames;
use crate::messages::{Path, TwistStamped};

/// A velocity stays in force for this time after its arrival; then the vehicle hovers. [ns]
pub const VELOCITY_LASTS_NS: u64 = 500_000_000;
/// Maximum number of points of a path.
pub const MOST_POINTS: usize = 32;

/// Why a command was rejected.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum CommandError {
    /// Unknown frame.
    #[error("unknown frame '{frame}'; give one of {known}")]
    Frame {
        /// Frame in the header.
        frame: String,
        /// Accepted frames.
        known: String,
    },
    /// A number is NaN or infinite.
    #[error("a number is not finite")]
    NotFinite,
    /// A path without a point, or with too many.
    #[error("a path has 1 to {MOST_POINTS} points, not {0}")]
    Points(usize),
}

/// Newest command, converted to a setpoint on request.
#[derive(Debug, Default)]
pub struct Commands {
    newest: Newest,
    paths: u32,
}

#[derive(Debug, Default)]
enum Newest {
    /// No command, or an expired one.
    #[default]
    Nothing,
    Velocity {
        setpoint: Setpoint,
        until_ns: u64,
    },
    Path(Trajectory),
    Land,
}

impl Commands {
    /// Processes a velocity that is `age_ns` old at `now_ns`. [ns, any one clock]
    ///
    /// # Errors
    /// [`CommandError`]; the previous command then stays in force.
    pub fn velocity(
        &mut self,
        frames: &Frames,
        twist: &TwistStamped,
        age_ns: u64,
        now_ns: u64,
    ) -> Result<(), CommandError> {
        let axes = frames.axes(&twist.header.frame_id)?;
        if !(twist.linear.is_finite() && twist.angular.is_finite()) {
            return Err(CommandError::NotFinite);
        }
        let turn = twist.angular.z;
        let yaw = if turn == 0.0 { YawTarget::Keep } else { YawTarget::Rate(turn) };
        let setpoint = Setpoint::Velocity { v_mps: twist.linear, axes, yaw };
        let until_ns = (now_ns + VELOCITY_LASTS_NS).saturating_sub(age_ns);
        self.replace(Newest::Velocity { setpoint, until_ns });
        Ok(())
    }

    /// Processes a path, which is flown once, at most at `speed_mps`.
    ///
    /// # Errors
    /// [`CommandError`]; the previous command then stays in force.
    pub fn path(
        &mut self,
        frames: &Frames,
        path: &Path,
        speed_mps: f64,
    ) -> Result<(), CommandError> {
        let frame = &path.header.frame_id;
        let axes = frames.axes(frame)?;
        let other = path.poses.iter().map(|pose| &pose.header.frame_id);
        if let Some(other) = other.into_iter().find(|&other| !other.is_empty() && other != frame) {
            return Err(CommandError::Frame { frame: other.clone(), known: frame.clone() });
        }
        if !(1..=MOST_POINTS).contains(&path.poses.len()) {
            return Err(CommandError::Points(path.poses.len()));
        }
        if !path.poses.iter().all(|pose| pose.position.is_finite()) {
            return Err(CommandError::NotFinite);
        }
        let waypoint = |p_m| Waypoint { p_m, speed_mps };
        let points = path.poses.iter().map(|pose| waypoint(pose.position)).collect();
        self.paths += 1;
        self.replace(Newest::Path(Trajectory {
            id: self.paths,
            axes,
            path: FlownPath::Waypoints(points),
            yaw: PathYaw::Ahead,
        }));
        Ok(())
    }

    /// Lands. Later commands of this flight are ignored.
    pub fn land(&mut self) {
        self.newest = Newest::Land;
    }

    /// Removes all commands before a new flight.
    pub fn clear(&mut self) {
        self.newest = Newest::Nothing;
    }

    fn replace(&mut self, newest: Newest) {
        if !matches!(self.newest, Newest::Land) {
            self.newest = newest;
        }
    }

    /// Returns the setpoint at `now_ns`.
    pub fn setpoint(&self, now_ns: u64) -> Setpoint {
        match &self.newest {
            Newest::Velocity { setpoint, until_ns } if now_ns < *until_ns => setpoint.clone(),
            Newest::Nothing | Newest::Velocity { .. } => Setpoint::Hold,
            Newest::Path(path) => Setpoint::Trajectory(path.clone()),
            Newest::Land => Setpoint::Land,
        }
    }
}

/// Suppresses repeated reports of the same fault, because velocities arrive at 50 Hz.
#[derive(Debug, Default)]
pub struct Reported(Option<String>);

impl Reported {
    /// Returns the message unless it equals the previous one.
    pub fn news(&mut self, topic: &str, fault: impl fmt::Display) -> Option<String> {
        let sentence = format!("{topic}: {fault}; command ignored");
        if self.0.as_ref() == Some(&sentence) {
            return None;
        }
        self.0 = Some(sentence.clone());
        Some(sentence)
    }
}

impl Frames {
    /// Returns the axes for the frame of a command.
    ///
    /// # Errors
    /// [`CommandError::Frame`] for all other names, including the empty one.
    pub fn axes(&self, frame: &str) -> Result<Axes, CommandError> {
        let known = [
            (&self.map, Axes::World),
            (&self.odom, Axes::World),
            (&self.base_stabilized, Axes::Heading),
            (&self.base_link, Axes::Body),
        ];
        if let Some(&(_, axes)) = known.iter().find(|(name, _)| *name == frame) {
            return Ok(axes);
        }
        let known: Vec<_> = known.iter().map(|(name, _)| name.as_str()).collect();
        Err(CommandError::Frame { frame: frame.to_owned(), known: known.join(", ") })
    }
}

#[cfg(test)]
mod tests {
    use vizflyt_sdk::glam::{DQuat, DVec3};

    use super::*;
    use crate::messages::{Header, PoseStamped, Time};

    fn twist(frame: &str, linear: DVec3, turn: f64) -> TwistStamped {
        let header = Header { stamp: Time::default(), frame_id: frame.to_owned() };
        TwistStamped { header, linear, angular: DVec3::Z * turn }
    }

    fn path(points: usize, frame: &str) -> Path {
        let header = Header { frame_id: frame.to_owned(), ..Header::default() };
        let pose = |at: usize| PoseStamped {
            header: Header::default(),
            position: DVec3::X * at as f64,
            orientation: DQuat::IDENTITY,
        };
        Path { header, poses: (0..points).map(pose).collect() }
    }

    #[test]
    fn velocity_applies_in_its_frame_until_its_deadline() {
        let (frames, mut commands) = (Frames::new(""), Commands::default());
        assert_eq!(commands.setpoint(0), Setpoint::Hold);
        for (frame, axes) in [
            ("map", Axes::World),
            ("odom", Axes::World),
            ("base_stabilized", Axes::Heading),
            ("base_link", Axes::Body),
        ] {
            commands.velocity(&frames, &twist(frame, DVec3::X, 0.5), 100, 1000).unwrap();
            let yaw = YawTarget::Rate(0.5);
            let expected = Setpoint::Velocity { v_mps: DVec3::X, axes, yaw };
            assert_eq!(commands.setpoint(VELOCITY_LASTS_NS + 899), expected);
            assert_eq!(commands.setpoint(VELOCITY_LASTS_NS + 900), Setpoint::Hold);
        }
        // A velocity older than the deadline is ignored.
        commands.velocity(&frames, &twist("map", DVec3::Y, 0.0), VELOCITY_LASTS_NS, 5000).unwrap();
        assert_eq!(commands.setpoint(5000), Setpoint::Hold);
    }

    #[test]
    fn rejects_invalid_commands_with_a_clear_message() {
        let (frames, mut commands) = (Frames::new("drone1/"), Commands::default());
        let error = commands.velocity(&frames, &twist("map", DVec3::X, 0.0), 0, 0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "unknown frame 'map'; give one of drone1/map, drone1/odom, \
             drone1/base_stabilized, drone1/base_link"
        );
        let nan = twist("drone1/map", DVec3::X * f64::NAN, 0.0);
        assert_eq!(commands.velocity(&frames, &nan, 0, 0), Err(CommandError::NotFinite));
        for points in [0, MOST_POINTS + 1] {
            let refused = commands.path(&frames, &path(points, "drone1/map"), 1.0);
            assert_eq!(refused, Err(CommandError::Points(points)));
        }
        assert_eq!(commands.setpoint(0), Setpoint::Hold);
        let mut reported = Reported::default();
        assert!(reported.news("/cmd_vel", &error).is_some());
        assert_eq!(reported.news("/cmd_vel", &error), None);
        assert!(reported.news("/cmd_vel", CommandError::NotFinite).is_some());
    }

    #[test]
    fn path_stays_until_another_command_and_landing_is_final() {
        let (frames, mut commands) = (Frames::new(""), Commands::default());
        commands.path(&frames, &path(MOST_POINTS, "map"), 0.8).unwrap();
        let first = commands.setpoint(0);
        let Setpoint::Trajectory(trajectory) = &first else { panic!("{first:?}") };
        assert!(trajectory.check().is_ok());
        assert_eq!(commands.setpoint(u64::MAX), first);
        commands.path(&frames, &path(2, "base_link"), 0.8).unwrap();
        let Setpoint::Trajectory(second) = commands.setpoint(0) else { panic!() };
        assert_ne!(second.id, trajectory.id);
        commands.land();
        commands.velocity(&frames, &twist("map", DVec3::X, 0.0), 0, 0).unwrap();
        assert_eq!(commands.setpoint(0), Setpoint::Land);
        commands.clear();
        assert_eq!(commands.setpoint(0), Setpoint::Hold);
    }
}
