//! Localization of the vehicle in the simulated lab, as arguments for the child processes.

use std::ffi::OsString;
use std::net::UdpSocket;

use anyhow::{Result, bail};
use clap::ValueEnum;
use glam::DVec3;
use vizflyt_tags::print::Pad;

/// Source of the server's poses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Localization {
    /// Vicon Tracker's UDP object stream
    #[default]
    Vicon,
    /// OptiTrack Motive's NatNet, y up
    Natnet,
    /// VizFlyt's JSON pose packets
    Json,
    /// AprilTags on the vehicle, seen by two simulated webcams in the room
    Tags,
    /// AprilTags on the floor, seen by one simulated webcam under the vehicle
    Mat,
}

impl Localization {
    /// Whether AprilTags are the only localization.
    pub(crate) fn is_by_tags(self) -> bool {
        matches!(self, Self::Tags | Self::Mat)
    }

    /// Rejects a fence that is larger than the area with tag localization. [m, world]
    pub(crate) fn check(self, fence_m: (DVec3, DVec3)) -> Result<()> {
        let (least_m, most_m) = fence_m;
        let seen =
            least_m.cmpge(HALL_M.0 - SLACK_M).all() && most_m.cmple(HALL_M.1 + SLACK_M).all();
        let why = match self {
            Self::Tags => "--localization tags: the two webcams see a hall of 11 x 4.5 m",
            Self::Mat => "--localization mat: the mat covers a hall of 11 x 4.5 m",
            _ => return Ok(()),
        };
        if !seen {
            let size_m = most_m - least_m;
            bail!(
                "{why}, and the fence of this scene is {:.0} x {:.0} m; use --scene room or race",
                size_m.x,
                size_m.y
            );
        }
        Ok(())
    }

    /// Returns the server's option. With port 0 the server prints the chosen address.
    pub(crate) fn of_server(self) -> OsString {
        match self {
            Self::Vicon => "--pose=vicon:127.0.0.1:0".into(),
            Self::Natnet => format!("--pose=natnet:{},up=y", unused()).into(),
            Self::Json | Self::Tags | Self::Mat => "--pose=json:127.0.0.1:0".into(),
        }
    }

    /// Returns the simulator's option: motion capture streams to the server at `poses`.
    pub(crate) fn of_simulator(self, poses: &str) -> String {
        match self {
            Self::Vicon => format!("--vicon={poses}"),
            Self::Natnet => format!("--mocap=natnet:{poses}"),
            Self::Json | Self::Tags | Self::Mat => format!("--mocap=json:{poses}"),
        }
    }

    /// Returns the command that locates tags and sends poses to the server at `poses`. It prints
    /// the address at which it receives the true poses, from which its cameras' images are
    /// rendered. A mat has pads for take-off and landing, and survey errors by `seed`.
    pub(crate) fn of_tags(self, poses: &str, pads: &[Pad], seed: u64) -> Vec<OsString> {
        let words = ["tags", "locate", "--json", "--lifeline", "--simulated"];
        let mut args: Vec<OsString> = words.map(OsString::from).to_vec();
        args.extend([format!("--to={poses}").into(), "--http=127.0.0.1:0".into()]);
        if self == Self::Mat {
            args.extend(["--inside-out".into(), format!("--seed={seed}").into()]);
            args.extend(pads.iter().map(|Pad { middle_m, size_m }| {
                format!("--pad={},{},{},{}", middle_m.x, middle_m.y, size_m.x, size_m.y).into()
            }));
        }
        args
    }
}

/// Volume that the webcams of `vizflyt_tags::simulated` see, and that its mat covers. [m, world]
const HALL_M: (DVec3, DVec3) = (DVec3::new(0.0, -2.25, 0.0), DVec3::new(11.0, 2.25, 3.65));
/// Part of the fence next to the net, in which the vehicle does not fly.
const SLACK_M: DVec3 = DVec3::splat(0.5);

/// Returns a free address of this computer for Motive, which starts after the server that connects
/// to it. If that fails, Motive's usual address.
fn unused() -> String {
    let found = UdpSocket::bind("127.0.0.1:0").and_then(|socket| socket.local_addr());
    found.map_or_else(|_| "127.0.0.1:1510".to_owned(), |address| address.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_rooms_that_the_cameras_do_not_cover() {
        let (room, forest) = (DVec3::new(11.0, 2.25, 3.5), DVec3::new(40.0, 5.0, 4.0));
        let least_m = DVec3::new(0.0, -2.25, 0.0);
        assert!(Localization::Tags.check((least_m, room)).is_ok());
        assert!(Localization::Mat.check((least_m, room)).is_ok());
        assert!(Localization::Vicon.check((least_m, forest)).is_ok());
        for (by, what) in [(Localization::Tags, "webcams see"), (Localization::Mat, "mat covers")] {
            let error = by.check((least_m, forest)).unwrap_err().to_string();
            assert!(
                error.contains("the fence of this scene is 40 x 7 m; use --scene room"),
                "{error}"
            );
            assert!(error.contains(what), "{error}");
        }
    }
}
