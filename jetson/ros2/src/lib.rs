//! A flight as a ROS 2 node, without ROS: `vizflyt ros2`, the command line's feature `ros2`.
//!
//! It is a plugin that attaches to `vizflyt fly --attach`: what a plugin sees goes out as ROS 2 messages over DDS, and
//! velocities and paths come in as setpoints, which pass the guard as any plugin's do. `docs/guides/ros2.md` is the guide.
//!
//! ```text
//! runtime -> sdk -> node  on_image --> convert -> messages, cdr -> dds --> rviz2, Nav2, rosbag2 ...
//!                         Setpoint <-- setpoint <- messages, cdr <- dds <--
//! ```
//! Only [`dds`] touches the network; conversions, messages and deadlines are pure. Why it is RustDDS stands there.

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

/// What the node logs unless told otherwise: the library's own steps are nobody's concern, nor that its end overtakes the
/// removal of a writer.
pub const LOG_LEVEL: &str = "info,rustdds=error,rustdds::dds::pubsub=off";
/// Between two looks for a runtime that waits.
const LOOK: Duration = Duration::from_millis(200);

/// A flight as a ROS 2 node: images, poses and IMU out, velocities and paths in
///
/// Attaches to `vizflyt fly --attach` on this computer, flight after flight, as a plugin does. The guide is
/// docs/guides/ros2.md.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt fly --attach                        in one terminal
  vizflyt ros2                                in another
  ros2 topic pub -r 20 /vizflyt/cmd_vel geometry_msgs/msg/TwistStamped \\
    '{header: {frame_id: base_stabilized}, twist: {linear: {x: 0.5}}}'
  ros2 topic pub --once /vizflyt/land std_msgs/msg/Empty")]
pub struct Ros2Args {
    /// The domain [default: $ROS_DOMAIN_ID, or 0]
    #[arg(long, value_name = "NUMBER", value_parser = clap::value_parser!(u16).range(..=232))]
    domain: Option<u16>,
    /// Begins the names of topics, but for /tf and /tf_static
    #[arg(long, value_name = "NAME", default_value = "vizflyt", value_parser = namespace)]
    namespace: String,
    /// Begins the names of frames: `drone1/` for one vehicle of several
    #[arg(long, value_name = "TEXT", default_value = "")]
    frame_prefix: String,
    /// How depth is sent
    #[arg(long, value_name = "ENCODING", default_value = "32fc1")]
    depth: DepthEncoding,
    /// Sends images, IMU and points reliably: for subscribers that ask for it, as rviz2 does unless told otherwise
    #[arg(long)]
    reliable: bool,
    /// How fast paths are flown at most [m/s]
    #[arg(long, value_name = "SPEED", default_value_t = 1.0, value_parser = speed)]
    path_speed: f64,
    /// Uses only this address of this computer; may be given again
    #[arg(long, value_name = "ADDRESS")]
    interface: Vec<IpAddr>,
    /// Ends with the first flight
    #[arg(long)]
    once: bool,
    /// Attaches to this runtime alone.
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

/// Runs the node: until a signal ends it, or with `--once` the flight.
///
/// # Errors
/// If the domain cannot be joined.
pub fn run(args: &Ros2Args) -> Result<ExitCode> {
    let domain = match args.domain {
        Some(domain) => domain,
        None => domain_of(std::env::var("ROS_DOMAIN_ID").ok().as_deref())?,
    };
    let dds = Arc::new(Participants::default());
    // Before the first thread, which all inherit this.
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

/// Returns the service of the only runtime that waits; else what it waits for, in a sentence.
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

/// Returns the domain that the environment names.
fn domain_of(variable: Option<&str>) -> Result<u16> {
    let Some(text) = variable.map(str::trim).filter(|text| !text.is_empty()) else { return Ok(0) };
    match text.parse() {
        Ok(domain @ 0..=232) => Ok(domain),
        _ => bail!("ROS_DOMAIN_ID is '{text}'; a domain is a number from 0 to 232"),
    }
}

/// On SIGINT and SIGTERM says goodbye to all participants and ends the process; the runtime then lands the vehicle.
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
    fn a_namespace_is_one_of_ros() {
        assert_eq!(namespace("/lab/drone1/"), Ok("lab/drone1".to_owned()));
        for bad in ["", "1drone", "a//b", "a b", "é"] {
            assert!(namespace(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn it_takes_no_flight_of_several() {
        let waiting = ["a".to_owned(), "b".to_owned()];
        assert_eq!(the_one(&waiting[..1]), Ok("a"));
        assert!(the_one(&[]).unwrap_err().contains("vizflyt fly --attach"));
        assert!(the_one(&waiting).unwrap_err().ends_with("one of a, b"));
    }

    #[test]
    fn the_domain_is_the_environments() {
        assert_eq!(domain_of(None).unwrap(), 0);
        assert_eq!(domain_of(Some("42")).unwrap(), 42);
        assert!(domain_of(Some("233")).is_err() && domain_of(Some("x")).is_err());
    }
}
