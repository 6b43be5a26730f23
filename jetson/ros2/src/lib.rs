//! A flight as a ROS 2 node, without ROS: `vizflyt ros2`, the command line's feature `ros2`.
//!
//! The node is a plugin that attaches to `vizflyt fly --attach`. It sends observations as ROS 2 messages over DDS, and
//! receives velocities and paths as setpoints, which pass the guard like those of any plugin. Guide:
//! `docs/guides/ros2.md`.
//!
//! ```text
//! runtime -> sdk -> node  on_image --> convert -> messages, cdr -> dds --> rviz2, Nav2, rosbag2 ...
//!                         Setpoint <-- setpoint <- messages, cdr <- dds <--
//! ```
//! Only [`dds`] uses the network; conversions, messages and deadlines are pure. [`dds`] also documents the choice of
//! RustDDS.

pub mod cdr;
pub mod convert;
mod dds;
pub mod messages;
mod node;
pub mod setpoint;
pub mod topics;

use std::net::IpAddr;
use std::process::ExitCode;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::sys::signal::{SigSet, Signal};

use self::convert::DepthEncoding;
use self::dds::Dds;
use self::node::{Node, Participants, Ros2};

/// Default log filter. It hides the library's internal steps, and warnings about writers that are removed while it
/// ends.
pub const LOG_LEVEL: &str = "info,rustdds=error,rustdds::dds::pubsub=off";
/// Interval between searches for a waiting runtime.
const LOOK: Duration = Duration::from_millis(200);

/// A flight as a ROS 2 node: images, poses and IMU out, velocities and paths in
///
/// Attaches to `vizflyt fly --attach` on this computer, flight after flight, as a plugin does. Guide:
/// docs/guides/ros2.md.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt fly --attach                        in one terminal
  vizflyt ros2                                in another
  ros2 topic pub -r 20 /vizflyt/cmd_vel geometry_msgs/msg/TwistStamped \\
    '{header: {frame_id: base_stabilized}, twist: {linear: {x: 0.5}}}'
  ros2 topic pub --once /vizflyt/land std_msgs/msg/Empty")]
pub struct Ros2Args {
    /// DDS domain [default: $ROS_DOMAIN_ID, or 0]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u16).range(..=232))]
    domain: Option<u16>,
    /// Prefix of all topic names except /tf and /tf_static
    #[arg(long, value_name = "NAME", default_value = "vizflyt", value_parser = namespace)]
    namespace: String,
    /// Prefix of frame names, for example `drone1/` for one vehicle of several
    #[arg(long, value_name = "TEXT", default_value = "")]
    frame_prefix: String,
    /// Encoding of depth
    #[arg(long, value_name = "ENCODING", default_value = "32fc1")]
    depth: DepthEncoding,
    /// Send images, IMU and points reliably, as rviz2 requests by default
    #[arg(long)]
    reliable: bool,
    /// Maximum speed on paths [m/s]
    #[arg(long, value_name = "SPEED", default_value_t = 1.0, value_parser = speed)]
    path_speed: f64,
    /// Use only this address of this computer; can be repeated
    #[arg(long, value_name = "ADDRESS")]
    interface: Vec<IpAddr>,
    /// End after the first flight
    #[arg(long)]
    once: bool,
    /// Attach only to this runtime
    #[arg(long = "vizflyt-service", value_name = "X", hide = true)]
    service: Option<String>,
}

fn namespace(text: &str) -> Result<String, String> {
    let name = text.trim_matches('/');
    let is_name = |part: &str| {
        part.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
    };
    if name.split('/').all(is_name) {
        Ok(name.to_owned())
    } else {
        Err("letters, digits and underscores, no digit first; `/` between parts".to_owned())
    }
}

fn speed(text: &str) -> Result<f64, String> {
    match text.parse() {
        Ok(speed) if speed > 0.0 && f64::is_finite(speed) => Ok(speed),
        _ => Err("a speed above zero [m/s]".to_owned()),
    }
}

/// Runs the node until a signal ends it, or with `--once` until the flight ends.
///
/// # Errors
/// If the domain cannot be joined.
pub fn run(args: &Ros2Args) -> Result<ExitCode> {
    let domain = match args.domain {
        Some(domain) => domain,
        None => domain_of(std::env::var("ROS_DOMAIN_ID").ok().as_deref())?,
    };
    let dds = Arc::new(Participants::default());
    // Before the first thread, because all threads inherit the signal mask.
    leave_on_signal(&dds)?;
    dds.join(|| Dds::join(domain, &args.interface, &args.namespace, args.reliable))?;
    let mut node = Node::new(args, &dds)?;
    tracing::info!("ROS 2 node /{} in domain {domain}", args.namespace);
    let mut said = String::new();
    loop {
        let waiting = args.service.clone().map_or_else(vizflyt_sdk::ipc::offers, |it| vec![it]);
        let service = match the_one(&waiting) {
            Ok(service) => service,
            Err(sentence) => {
                if sentence != said {
                    tracing::info!("{sentence}");
                    said = sentence;
                }
                thread::sleep(LOOK);
                continue;
            }
        };
        said.clear();
        let code = vizflyt_sdk::attach(Ros2(&mut node), service);
        if args.once && node.has_flown() {
            drop(node);
            dds.leave();
            return Ok(code);
        }
        thread::sleep(LOOK);
    }
}

/// Returns the service of the only waiting runtime, or a sentence with the reason to wait.
fn the_one(waiting: &[String]) -> Result<&str, String> {
    match waiting {
        [service] => Ok(service),
        [] => Err("waits for a flight: `vizflyt fly --attach` in another terminal".to_owned()),
        several => Err(format!(
            "{} flights wait for a plugin: choose one with --vizflyt-service X, X being one of {}",
            several.len(),
            several.join(", ")
        )),
    }
}

/// Returns the domain given by the environment variable.
fn domain_of(variable: Option<&str>) -> Result<u16> {
    let Some(text) = variable.map(str::trim).filter(|text| !text.is_empty()) else { return Ok(0) };
    match text.parse() {
        Ok(domain @ 0..=232) => Ok(domain),
        _ => bail!("ROS_DOMAIN_ID is '{text}'; a domain is a number from 0 to 232"),
    }
}

/// On SIGINT and SIGTERM, leaves the DDS domain and ends the process; the runtime then lands the vehicle.
fn leave_on_signal(dds: &Arc<Participants>) -> Result<()> {
    let mut signals = SigSet::empty();
    signals.add(Signal::SIGINT);
    signals.add(Signal::SIGTERM);
    signals.thread_block().context("cannot watch for signals")?;
    let dds = Arc::clone(dds);
    thread::Builder::new()
        .name("signals".to_owned())
        .spawn(move || {
            let _ = signals.wait();
            dds.leave();
            std::process::exit(0);
        })
        .context("cannot watch for signals")?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn accepts_only_valid_ros_namespaces() {
        assert_eq!(namespace("/lab/drone1/"), Ok("lab/drone1".to_owned()));
        for bad in ["", "1drone", "a//b", "a b", "é"] {
            assert!(namespace(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn attaches_only_if_one_flight_waits() {
        let waiting = ["a".to_owned(), "b".to_owned()];
        assert_eq!(the_one(&waiting[..1]), Ok("a"));
        assert!(the_one(&[]).unwrap_err().contains("vizflyt fly --attach"));
        assert!(the_one(&waiting).unwrap_err().ends_with("one of a, b"));
    }

    #[test]
    fn reads_the_domain_from_the_environment() {
        assert_eq!(domain_of(None).unwrap(), 0);
        assert_eq!(domain_of(Some("42")).unwrap(), 42);
        assert!(domain_of(Some("233")).is_err() && domain_of(Some("x")).is_err());
    }
}
