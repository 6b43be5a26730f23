//! Commands from ROS 2 as setpoints: velocities with a deadline, paths, and the landing. Pure: what comes, and when.

use std::fmt;

use thiserror::Error;
use vizflyt_sdk::{Axes, Path as FlownPath, PathYaw, Setpoint, Trajectory, Waypoint, YawTarget};

use crate::convert::Frames;
use crate::messages::{Path, TwistStamped};

/// A velocity counts for so long after it came; then the vehicle hovers. [ns]
pub const VELOCITY_LASTS_NS: u64 = 500_000_000;
/// Points of a path that the runtime takes.
pub const MOST_POINTS: usize = 32;

/// Why a command does not count.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum CommandError {
    /// Its frame is none of those in which commands are understood.
    #[error("frame '{frame}' is not known; give one of {known}")]
    Frame {
        /// What its header has.
        frame: String,
        /// What it may have.
        known: String,
    },
    /// A number of it is NaN or infinite.
    #[error("a number of it is not finite")]
    NotFinite,
    /// A path without a point, or with too many.
    #[error("a path has 1 to {MOST_POINTS} points, not {0}")]
    Points(usize),
}

/// What was asked for last.
#[derive(Debug, Default)]
pub struct Commands {
    newest: Newest,
    paths: u32,
}

#[derive(Debug, Default)]
enum Newest {
    /// Nothing, or what has run out.
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
    /// Takes a velocity that is `age_ns` old at `now_ns`. [ns, any one clock]
    ///
    /// # Errors
    /// [`CommandError`]; the former command stays in force then.
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

    /// Takes a path, which is flown once, at `speed_mps` at most.
    ///
    /// # Errors
    /// [`CommandError`]; the former command stays in force then.
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

    /// Lands; nothing that comes later in this flight counts.
    pub fn land(&mut self) {
        self.newest = Newest::Land;
    }

    /// Forgets all: another flight begins.
    pub fn clear(&mut self) {
        self.newest = Newest::Nothing;
    }

    fn replace(&mut self, newest: Newest) {
        if !matches!(self.newest, Newest::Land) {
            self.newest = newest;
        }
    }

    /// Returns what the vehicle is to do at `now_ns`.
    pub fn setpoint(&self, now_ns: u64) -> Setpoint {
        match &self.newest {
            Newest::Velocity { setpoint, until_ns } if now_ns < *until_ns => setpoint.clone(),
            Newest::Nothing | Newest::Velocity { .. } => Setpoint::Hold,
            Newest::Path(path) => Setpoint::Trajectory(path.clone()),
            Newest::Land => Setpoint::Land,
        }
    }
}

/// The same fault is reported once until another comes: a velocity comes fifty times a second.
#[derive(Debug, Default)]
pub struct Reported(Option<String>);

impl Reported {
    /// Returns the sentence if it is not the one before.
    pub fn news(&mut self, topic: &str, fault: impl fmt::Display) -> Option<String> {
        let sentence = format!("{topic}: {fault}; it does not count");
        if self.0.as_ref() == Some(&sentence) {
            return None;
        }
        self.0 = Some(sentence.clone());
        Some(sentence)
    }
}

impl Frames {
    /// Returns the axes that a frame's name means in a command.
    ///
    /// # Errors
    /// [`CommandError::Frame`] for any other name, the empty one too.
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
    fn a_velocity_counts_in_its_frame_until_its_deadline() {
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
        // One that is older than the deadline never counts.
        commands.velocity(&frames, &twist("map", DVec3::Y, 0.0), VELOCITY_LASTS_NS, 5000).unwrap();
        assert_eq!(commands.setpoint(5000), Setpoint::Hold);
    }

    #[test]
    fn what_cannot_be_meant_is_refused_in_a_sentence() {
        let (frames, mut commands) = (Frames::new("drone1/"), Commands::default());
        let error = commands.velocity(&frames, &twist("map", DVec3::X, 0.0), 0, 0).unwrap_err();
        assert_eq!(
            error.to_string(),
            "frame 'map' is not known; give one of drone1/map, drone1/odom, \
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
    fn a_path_goes_on_until_another_command_and_a_landing_is_the_end() {
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
