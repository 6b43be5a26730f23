//! Command line of `vizflyt sim`, and of this crate's own binary.

use std::net::SocketAddr;
use std::path::PathBuf;

use anyhow::Context;
use clap::Args;
use glam::DVec3;
use vizflyt_process::print_line;
use vizflyt_protocol::geometry::Volume;

use crate::autopilot::airframe;
use crate::driver::Driver;
use crate::imu::ImuModel;
use crate::link::serial::{DEFAULT_BAUD, baud_rate};
use crate::link::{Endpoint, resolve};
use crate::mocap::feed::{FeedTarget, Format};
use crate::mocap::{MAX_NAME, MocapConfig};
use crate::simulation::faults::{Faults, MotorFault};
use crate::simulation::{Simulation, SimulationConfig};
use crate::startup::Startup;
use crate::truth_feed::TruthFeed;
use crate::wifi::WifiConfig;

/// The simulated lab: vehicle, autopilot and motion capture
#[derive(Args, Clone, Debug)]
#[command(
    after_help = "Examples:\n  vizflyt sim --mavlink udpout:127.0.0.1:14550 --vicon 127.0.0.1:51001 --spawn 1,0,0,90\n  \
                  vizflyt sim --pty /tmp/uart --baud 921600 --vicon 127.0.0.1:51001"
)]
pub struct SimArgs {
    /// True geometry of the scene, for clearance (JSON list of volumes)
    #[arg(long, help_heading = "Scene", value_name = "FILE")]
    pub truth: Option<PathBuf>,
    /// Radius of the vehicle's body, for clearance [m]
    #[arg(long, help_heading = "Scene", value_name = "METRES", default_value_t = 0.12)]
    pub body_radius: f64,
    /// Steady wind, world axes [m/s]
    #[arg(long, help_heading = "Scene", value_name = "X,Y,Z", default_value = "0,0,0", value_parser = parse_numbers::<3>, allow_hyphen_values = true)]
    pub wind: [f64; 3],
    /// Standard deviation of gusts along each horizontal axis [m/s]
    #[arg(long, help_heading = "Scene", value_name = "M/S", default_value_t = 0.0)]
    pub gusts: f64,
    /// Start of the vehicle: position on the floor [m], yaw from east [degrees]
    #[arg(long, help_heading = "Vehicle", value_name = "X,Y,Z,YAW", default_value = "0,0,0,0", value_parser = parse_numbers::<4>, allow_hyphen_values = true)]
    pub spawn: [f64; 4],
    /// Move the vehicle by hand instead of flying
    ///
    /// Repeats: lift, push forward, turn left, raise the nose, raise the left side. The IMU measures these motions.
    /// `vizflyt doctor localization` needs them.
    #[arg(long, help_heading = "Vehicle")]
    pub hand: bool,
    /// Use the parameters of `hardware/airframe`
    ///
    /// Otherwise, the defaults of ArduCopter apply, which respond late to velocity setpoints.
    #[arg(long, help_heading = "Vehicle")]
    pub airframe: bool,
    /// Change a parameter of the autopilot at boot; may be repeated
    #[arg(long = "param", help_heading = "Vehicle", value_name = "NAME=VALUE", value_parser = parse_param)]
    pub params: Vec<(String, f32)>,
    /// Start-up times of a real autopilot
    ///
    /// Alignment takes 2 s and external navigation 1 s. Otherwise, the vehicle was powered before the start, and its
    /// position is valid after 0.2 s.
    #[arg(long, help_heading = "Vehicle")]
    pub realistic_startup: bool,
    /// Inertial sensor of the autopilot
    #[arg(long, help_heading = "Vehicle", value_name = "NAME", default_value_t, help = format!(
        "Inertial sensor: {}", ImuModel::names()
    ), long_help = format!(
        "Inertial sensor (frame: noise by a small frame; chips: by data sheet): {}",
        ImuModel::names()
    ))]
    pub imu: ImuModel,
    /// Vibration by each unbalanced rotor at full throttle [m/s^2]
    ///
    /// With 200, a hovering vehicle reports about 30, at which ArduPilot warns.
    #[arg(long, help_heading = "Vehicle", value_name = "M/S^2", default_value_t = 0.0)]
    pub vibration: f64,
    /// Charge of the battery at the start [%]
    #[arg(long, help_heading = "Vehicle", value_name = "PERCENT", default_value_t = 100.0)]
    pub battery: f64,
    /// Simulate a connected radio control with its transmitter on
    #[arg(long, help_heading = "Vehicle")]
    pub radio: bool,
    /// Motor (1 to 4, ArduCopter's order) that fails, and time after take-off [s]
    ///
    /// The motor then gives PERCENT of its thrust, or nothing if PERCENT is absent.
    #[arg(long, help_heading = "Faults", value_name = "MOTOR@SECONDS[,PERCENT]", value_parser = parse_motor_fault)]
    pub motor_failure: Option<MotorFault>,
    /// Time after take-off at which the transmitter falls silent [s]
    #[arg(long, help_heading = "Faults", value_name = "SECONDS", requires = "radio")]
    pub radio_lost_after: Option<f64>,
    /// Time after take-off at which the autopilot reboots; motors stop at once [s]
    #[arg(long, help_heading = "Faults", value_name = "SECONDS")]
    pub reboot_after: Option<f64>,
    /// Destination of Vicon's UDP object stream; none if absent
    #[arg(long, help_heading = "Localization", value_name = "HOST:PORT", value_parser = parse_address)]
    pub vicon: Option<SocketAddr>,
    /// Destination of another motion capture format; may be repeated
    ///
    /// Formats: vicon, json or mavlink with a destination; natnet with the address where Motive waits for listeners, or
    /// with a multicast group.
    #[arg(long, help_heading = "Localization", value_name = "FORMAT:HOST:PORT")]
    pub mocap: Vec<FeedTarget>,
    /// Name of the vehicle in the motion capture
    #[arg(long, help_heading = "Localization", value_name = "NAME", default_value = "vizflyt", value_parser = parse_object)]
    pub object: String,
    /// Destination of the true pose at every tick; may be repeated
    ///
    /// Sends the JSON that `vizflyt serve` reads poses from, with the instant on CLOCK_MONOTONIC. `vizflyt tags locate`
    /// renders the images of its simulated cameras from it.
    #[arg(long, help_heading = "Localization", value_name = "HOST:PORT", value_parser = parse_address)]
    pub truth_to: Vec<SocketAddr>,
    /// Additional latency of the motion capture [ms]
    #[arg(long, help_heading = "Localization", value_name = "MS", default_value_t = 0.0)]
    pub mocap_delay_ms: f64,
    /// Share of lost datagrams of the motion capture [%]
    #[arg(long, help_heading = "Localization", value_name = "PERCENT", default_value_t = 0.0)]
    pub mocap_drop_percent: f64,
    /// Time after which the motion capture falls silent [s]
    #[arg(long, help_heading = "Localization", value_name = "SECONDS")]
    pub mocap_stop_after: Option<f64>,
    /// Endpoint of MAVLink; up to four, like telemetry ports of one autopilot
    ///
    /// udpout:HOST:PORT sends first, udpin:HOST:PORT and tcpin:HOST:PORT wait, tcpout:HOST:PORT connects;
    /// serial:PATH[:BAUD] and pty:PATH[:BAUD] are like --serial and --pty. Default: udpout:127.0.0.1:14550, unless
    /// --serial or --pty is given.
    #[arg(long, help_heading = "MAVLink", value_name = "ENDPOINT")]
    pub mavlink: Vec<Endpoint>,
    /// Serial device, or existing pseudo-terminal, for MAVLink
    ///
    /// Waits until the device exists.
    #[arg(long, help_heading = "MAVLink", value_name = "PATH")]
    pub serial: Option<PathBuf>,
    /// Create a pseudo-terminal for MAVLink, and a link to it with this name
    #[arg(long, help_heading = "MAVLink", value_name = "PATH", conflicts_with = "serial")]
    pub pty: Option<PathBuf>,
    /// Baud rate of --serial and --pty; limits the speed of sending
    #[arg(long, help_heading = "MAVLink", value_name = "BAUD", default_value_t = DEFAULT_BAUD, value_parser = parse_baud)]
    pub baud: u32,
    /// Send MAVLink through a model of an ESP8266's Wi-Fi
    ///
    /// Batches of 2 to 5 ms, latency, and bursts of loss.
    #[arg(long, help_heading = "Wi-Fi")]
    pub wifi: bool,
    /// Latency of --wifi [ms]
    #[arg(
        long,
        help_heading = "Wi-Fi",
        value_name = "MS",
        default_value_t = 2.0,
        requires = "wifi"
    )]
    pub wifi_latency_ms: f64,
    /// Mean additional latency by contention with --wifi [ms]
    #[arg(
        long,
        help_heading = "Wi-Fi",
        value_name = "MS",
        default_value_t = 1.0,
        requires = "wifi"
    )]
    pub wifi_jitter_ms: f64,
    /// Share of lost batches with --wifi [%]
    #[arg(
        long,
        help_heading = "Wi-Fi",
        value_name = "PERCENT",
        default_value_t = 1.0,
        requires = "wifi"
    )]
    pub wifi_loss_percent: f64,
    /// Mean number of batches lost in a row with --wifi
    #[arg(
        long,
        help_heading = "Wi-Fi",
        value_name = "BATCHES",
        default_value_t = 3.0,
        requires = "wifi"
    )]
    pub wifi_burst: f64,
    /// Seed of all noise
    #[arg(long, help_heading = "Simulation", default_value_t = 0)]
    pub seed: u64,
    /// Simulated seconds per second
    #[arg(long, help_heading = "Simulation", value_name = "FACTOR", default_value_t = 1.0)]
    pub realtime_factor: f64,
    /// Print JSON lines on stdout: one when ready, one report at the end
    #[arg(long, help_heading = "Output")]
    pub json: bool,
    /// End when stdin ends
    #[arg(long, hide = true)]
    pub lifeline: bool,
}

fn parse_address(text: &str) -> Result<SocketAddr, String> {
    resolve(text).ok_or_else(|| format!("'{text}' is not HOST:PORT"))
}

fn parse_baud(text: &str) -> Result<u32, String> {
    let baud = text.parse().ok().filter(|&baud| baud_rate(baud).is_some());
    baud.ok_or_else(|| {
        format!("'{text}' is not a baud rate of a telemetry port; give 57600 to 3000000")
    })
}

fn parse_object(text: &str) -> Result<String, String> {
    if (1..=MAX_NAME).contains(&text.len()) && text.is_ascii() {
        Ok(text.to_owned())
    } else {
        Err(format!("an object name has 1 to {MAX_NAME} ASCII characters"))
    }
}

fn parse_numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|part| part.trim().parse::<f64>().ok().filter(|v| v.is_finite() && v.abs() <= 1e4))
        .collect::<Option<_>>()
        .ok_or_else(|| format!("'{text}': give {N} numbers separated by commas"))?;
    let count = numbers.len();
    numbers.try_into().map_err(|_| format!("'{text}' has {count} numbers; give {N}"))
}

fn parse_motor_fault(text: &str) -> Result<MotorFault, String> {
    let read = || {
        let (motor, rest) = text.split_once('@')?;
        let (after_s, percent) = rest.split_once(',').unwrap_or((rest, "0"));
        let motor = motor.parse::<usize>().ok().filter(|motor| (1..=4).contains(motor))? - 1;
        let after_s = after_s.parse::<f64>().ok().filter(|s| (0.0..=1e6).contains(s))?;
        let percent = percent.parse::<f64>().ok().filter(|p| (0.0..=100.0).contains(p))?;
        Some(MotorFault { motor, share: percent / 100.0, after_s })
    };
    read().ok_or_else(|| format!("'{text}': write MOTOR@SECONDS or MOTOR@SECONDS,PERCENT, as 2@5"))
}

fn parse_param(text: &str) -> Result<(String, f32), String> {
    text.split_once('=')
        .and_then(|(name, value)| Some((name.to_owned(), value.parse::<f32>().ok()?)))
        .filter(|(_, value)| value.is_finite())
        .ok_or_else(|| format!("'{text}': write NAME=VALUE, for example FS_GCS_ENABLE=0"))
}

impl SimArgs {
    /// Returns the MAVLink endpoints.
    pub fn endpoints(&self) -> Vec<Endpoint> {
        let mut all = self.mavlink.clone();
        all.extend(self.serial.iter().map(|path| Endpoint::Serial(path.clone(), self.baud)));
        all.extend(self.pty.iter().map(|path| Endpoint::Pty(path.clone(), self.baud)));
        if all.is_empty() {
            all.push(Endpoint::UdpOut(([127, 0, 0, 1], 14550).into()));
        }
        all
    }

    /// Returns the configuration of the lab. Reads the file of true geometry.
    ///
    /// # Errors
    /// Fails if that file cannot be read, or an argument is out of range.
    pub fn config(&self) -> anyhow::Result<SimulationConfig> {
        let in_range = |name: &str, value: f64, range: std::ops::RangeInclusive<f64>| {
            let (least, most) = (*range.start(), *range.end());
            anyhow::ensure!(
                range.contains(&value),
                "simulator: --{name} {value} is outside {least} to {most}"
            );
            Ok(())
        };
        in_range("body-radius", self.body_radius, 0.0..=10.0)?;
        in_range("realtime-factor", self.realtime_factor, 0.01..=20.0)?;
        in_range("mocap-delay-ms", self.mocap_delay_ms, 0.0..=10_000.0)?;
        in_range("mocap-drop-percent", self.mocap_drop_percent, 0.0..=100.0)?;
        in_range("mocap-stop-after", self.mocap_stop_after.unwrap_or(0.0), 0.0..=1e9)?;
        in_range("gusts", self.gusts, 0.0..=20.0)?;
        in_range("vibration", self.vibration, 0.0..=2000.0)?;
        in_range("battery", self.battery, 0.0..=100.0)?;
        in_range("radio-lost-after", self.radio_lost_after.unwrap_or(0.0), 0.0..=1e9)?;
        in_range("reboot-after", self.reboot_after.unwrap_or(0.0), 0.0..=1e9)?;
        in_range("wifi-latency-ms", self.wifi_latency_ms, 0.0..=10_000.0)?;
        in_range("wifi-jitter-ms", self.wifi_jitter_ms, 0.0..=10_000.0)?;
        in_range("wifi-loss-percent", self.wifi_loss_percent, 0.0..=100.0)?;
        in_range("wifi-burst", self.wifi_burst, 1.0..=10_000.0)?;
        let [x, y, z, yaw_deg] = self.spawn;
        Ok(SimulationConfig {
            spawn_m: DVec3::new(x, y, z),
            spawn_yaw_rad: yaw_deg.to_radians(),
            seed: self.seed,
            obstacles: self.obstacles()?,
            body_radius_m: self.body_radius,
            mocap: MocapConfig {
                object: self.object.clone(),
                seed: self.seed,
                stop_after_s: self.mocap_stop_after,
                latency_s: self.mocap_delay_ms / 1000.0,
                loss: self.mocap_drop_percent / 100.0,
            },
            hand: self.hand,
            startup: if self.realistic_startup { Startup::Realistic } else { Startup::Quick },
            params: if self.airframe { airframe() } else { Vec::new() }
                .into_iter()
                .chain(self.params.iter().cloned())
                .collect(),
            wind_world_mps: DVec3::from(self.wind),
            gust_mps: self.gusts,
            imu: self.imu,
            vibration_mps2: self.vibration,
            battery_share: self.battery / 100.0,
            radio: self.radio,
            faults: Faults {
                motor: self.motor_failure,
                radio_lost_after_s: self.radio_lost_after,
                reboot_after_s: self.reboot_after,
            },
            wifi: self.wifi.then_some(WifiConfig {
                seed: self.seed,
                latency_s: self.wifi_latency_ms / 1000.0,
                jitter_s: self.wifi_jitter_ms / 1000.0,
                loss: self.wifi_loss_percent / 100.0,
                burst: self.wifi_burst,
                ..WifiConfig::default()
            }),
        })
    }

    fn obstacles(&self) -> anyhow::Result<Vec<Volume>> {
        let Some(path) = &self.truth else { return Ok(Vec::new()) };
        let text = std::fs::read_to_string(path).with_context(|| {
            format!("simulator: cannot read the true geometry {}", path.display())
        })?;
        let volumes: Vec<Volume> = serde_json::from_str(&text)
            .with_context(|| format!("simulator: {} is not a list of volumes", path.display()))?;
        if let Some(index) = volumes.iter().position(|volume| !volume.is_valid()) {
            anyhow::bail!(
                "simulator: {}: volume {index} has a size, direction or number that is not valid",
                path.display()
            );
        }
        Ok(volumes)
    }
}

/// Runs the simulated lab until SIGINT, SIGTERM, or with `lifeline` until the end of stdin. Prints the ready line and
/// the report on stdout.
///
/// # Errors
/// Fails on arguments out of range, unreadable files, and sockets that cannot be opened.
// Why: by value, like every run function of the command line.
#[allow(clippy::needless_pass_by_value)]
pub fn run(args: SimArgs) -> anyhow::Result<()> {
    let stop = vizflyt_process::stop_flag(args.lifeline)?;
    let simulation = Simulation::new(args.config()?)?;
    let endpoints = args.endpoints();
    let truth: std::io::Result<Vec<TruthFeed>> =
        args.truth_to.iter().map(|target| TruthFeed::open(*target, &args.object)).collect();
    let vicon = args.vicon.map(|address| FeedTarget { format: Format::Vicon, address });
    let mocap: Vec<_> = vicon.into_iter().chain(args.mocap.iter().copied()).collect();
    let driver = Driver::open(simulation, &endpoints, &mocap, args.realtime_factor)?
        .telling_truth(truth.context("simulator: cannot open a socket for the true pose")?);
    let addresses = driver.mavlink_addresses()?;
    if args.json {
        let ready = serde_json::json!({
            "ready": "simulator", "mavlink": addresses[0], "links": addresses,
            "mocap": driver.mocap_addresses()?,
        });
        print_line(ready);
    } else {
        for (endpoint, address) in endpoints.iter().zip(&addresses) {
            print_line(format!("MAVLink {endpoint} (our address {address})"));
        }
        print_line("simulator ready; Ctrl-C ends it");
    }
    // The loop runs in a separate thread, because the caller's thread may be busy.
    let (simulation, lost_s) = std::thread::Builder::new()
        .name("simulator".into())
        .spawn(move || driver.run(&stop))
        .context("simulator: cannot start its thread")?
        .join()
        .map_err(|_| anyhow::anyhow!("simulator: its thread panicked"))?;
    let report = simulation.report();
    if args.json {
        let mut report = serde_json::to_value(&report).context("simulator: report")?;
        report["seconds_given_up"] = lost_s.into();
        print_line(serde_json::json!({ "report": report }));
    } else {
        let truth = &report.truth;
        print_line(format!(
            "flew {:.1} s, {:.1} m, at {:.1} m/s on average and {:.1} m/s at most; {}{}",
            truth.flight_seconds,
            truth.path_m,
            truth.mean_speed_mps,
            truth.max_speed_mps,
            truth
                .min_clearance_m
                .map_or("no obstacles".into(), |m| format!("least clearance {m:.2} m")),
            if truth.collided { ", collided" } else { "" },
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Command {
        #[command(flatten)]
        args: SimArgs,
    }

    fn parse(arguments: &[&str]) -> Result<SimArgs, String> {
        Command::try_parse_from(std::iter::once(&"sim").chain(arguments))
            .map(|command| command.args)
            .map_err(|error| error.to_string())
    }

    #[test]
    fn accepts_the_arguments_of_the_demo() {
        let args = parse(&[
            "--json",
            "--lifeline",
            "--mavlink",
            "udpout:127.0.0.1:4000",
            "--vicon",
            "127.0.0.1:4001",
            "--object",
            "vizflyt",
            "--spawn",
            "-1,0.5,0,90",
            "--seed",
            "7",
            "--param",
            "WP_SPD=2",
        ])
        .unwrap();
        let config = args.config().unwrap();
        assert_eq!(config.spawn_m, DVec3::new(-1.0, 0.5, 0.0));
        assert!((config.spawn_yaw_rad - 90f64.to_radians()).abs() < 1e-12);
        assert_eq!(config.params, [("WP_SPD".to_owned(), 2.0)]);
        Simulation::new(config).unwrap();
    }

    #[test]
    fn collects_all_mavlink_endpoints() {
        let check = |arguments: &[&str], expected: &[&str]| {
            let found = parse(arguments).unwrap().endpoints();
            assert_eq!(found.iter().map(ToString::to_string).collect::<Vec<_>>(), expected);
        };
        check(&[], &["udpout:127.0.0.1:14550"]);
        check(&["--serial", "/dev/ttyS0", "--baud", "57600"], &["serial:/dev/ttyS0:57600"]);
        check(
            &["--mavlink", "tcpin:127.0.0.1:1", "--pty", "/tmp/u"],
            &["tcpin:127.0.0.1:1", "pty:/tmp/u:921600"],
        );
    }

    #[test]
    fn parses_faults_and_wifi() {
        let args =
            parse(&["--motor-failure", "2@5.5,30", "--reboot-after", "3", "--wifi"]).unwrap();
        let config = args.config().unwrap();
        let motor = MotorFault { motor: 1, share: 0.3, after_s: 5.5 };
        assert_eq!((config.faults.motor, config.faults.reboot_after_s), (Some(motor), Some(3.0)));
        assert_eq!(config.wifi, Some(WifiConfig::default()));
        assert_eq!(parse(&[]).unwrap().config().unwrap().wifi, None);
    }

    #[test]
    fn names_invalid_arguments() {
        let check = |arguments: &[&str], expected: &str| {
            let error = parse(arguments)
                .map_err(anyhow::Error::msg)
                .and_then(|args| Simulation::new(args.config()?).map_err(anyhow::Error::from));
            let error = error.err().map(|e: anyhow::Error| format!("{e:#}")).unwrap_or_default();
            assert!(error.contains(expected), "{arguments:?}: {error}");
        };
        check(&["--spawn", "1,2,3"], "has 3 numbers; give 4");
        check(&["--spawn", "1,2,x,4"], "give 4 numbers");
        check(&["--mavlink", "udp:1"], "udpout:HOST:PORT");
        check(&["--motor-failure", "5@1"], "MOTOR@SECONDS");
        check(&["--wifi-latency-ms", "5"], "--wifi");
        check(&["--radio-lost-after", "5"], "--radio");
        check(&["--battery", "130"], "outside 0 to 100");
        check(&["--baud", "1234"], "not a baud rate");
        check(&["--serial", "/a", "--pty", "/b"], "cannot be used with");
        check(&["--object", "a name of more than twenty-four"], "1 to 24");
        check(&["--realtime-factor", "0"], "outside 0.01 to 20");
        check(&["--imu", "mpu"], "unknown inertial sensor 'mpu'; use one of frame, icm-42688-p");
        check(&["--param", "NO_SUCH=1"], "no parameter NO_SUCH");
        check(&["--truth", "/does/not/exist.json"], "cannot read the true geometry");
    }
}
