//! `vizflyt tags locate`: locates the vehicle in images, and sends its pose over UDP to the render
//! server.
//!
//! ```text
//! sources   one thread per camera: images with their exposure stamps --> mailbox, newest wins
//! locator   this thread: vizflyt_tags::locate                      --> pose packets, status lines
//! view      a page with images, detections and residuals, if requested
//! ```

mod sources;
mod view;

use std::fmt::Display;
use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use serde_json::{Value, json};
use vizflyt_process::{print_line, stop_flag};
use vizflyt_tags::locate::{LocateOutcome, LocateSetup, Located, Locator, StampedImage, Unlocated};
use vizflyt_tags::print::Pad;

use self::sources::{CameraEvent, CameraImage, Sources};
use self::view::LiveView;

/// Locate the vehicle by AprilTags and send its pose to the server
#[derive(Args, Debug)]
#[command(after_help = "The configuration file lists cameras and layouts, relative to its folder:
  object  = \"vizflyt\"
  cameras = [\"west.toml\", \"east.toml\"]   # from `tags calibrate` and `tags survey`
  layouts = [\"cube.toml\"]                # from `tags print`; or a surveyed mat")]
pub(crate) struct LocateArgs {
    /// Configuration file; not needed with --simulated
    #[arg(required_unless_present = "simulated", conflicts_with = "simulated")]
    config: Option<PathBuf>,
    /// Name of the vehicle [default: that of the file]
    #[arg(long, help_heading = "Localization")]
    object: Option<String>,
    /// Source of a camera's images instead of its file's; can be repeated
    ///
    /// A device, a folder or a video.
    #[arg(long = "source", help_heading = "Localization", value_name = "CAMERA=SOURCE", value_parser = parse_source)]
    sources: Vec<(String, String)>,
    /// Use simulated webcams at the ends of the netted hall
    ///
    /// They see a cube of tags at the true pose of the vehicle. In a configuration file, cameras
    /// with the source "simulated" do the same.
    #[arg(long, help_heading = "Simulation")]
    simulated: bool,
    /// Number of simulated webcams, 1 to 4
    #[arg(long, help_heading = "Simulation", default_value_t = 2, value_parser = clap::value_parser!(u8).range(1..=4), requires = "simulated")]
    webcams: u8,
    /// Simulate a webcam under the vehicle that sees a mat of tags on the floor
    #[arg(long, help_heading = "Simulation", requires = "simulated", conflicts_with = "webcams")]
    inside_out: bool,
    /// Pad of small tags on that mat: centre east, north and size; can be repeated
    ///
    /// In metres, world frame. [default size: 0.5,0.35]
    #[arg(long = "pad", help_heading = "Simulation", value_name = "X,Y[,LENGTH,WIDTH]", value_parser = super::print::pad, allow_hyphen_values = true, requires = "inside_out")]
    pads: Vec<Pad>,
    /// Seed of the simulated errors of survey and mount
    #[arg(long, help_heading = "Simulation", default_value_t = 7, requires = "inside_out")]
    seed: u64,
    /// Address for true poses, for simulated cameras: `vizflyt sim --truth-to` this
    #[arg(
        long,
        help_heading = "Simulation",
        value_name = "ADDR:PORT",
        default_value = "127.0.0.1:0"
    )]
    truth: SocketAddr,
    /// Destination of the poses: `vizflyt serve --pose json:ADDR`; can be repeated
    #[arg(long, help_heading = "Network", value_name = "HOST:PORT", value_parser = resolve)]
    to: Vec<SocketAddr>,
    /// Address of the live view: images, detections, residuals
    #[arg(long, help_heading = "Network", value_name = "ADDR:PORT")]
    http: Option<SocketAddr>,
    /// Print JSON lines: `ready`, `status` once a second, `report`
    #[arg(long, help_heading = "Output")]
    json: bool,
    /// Print every pose as a JSON line when it is sent
    #[arg(long, help_heading = "Output")]
    poses: bool,
    /// End when standard input closes
    #[arg(long, hide = true)]
    lifeline: bool,
}

fn resolve(text: &str) -> Result<SocketAddr, String> {
    text.to_socket_addrs()
        .map_err(|error| format!("{error}; give HOST:PORT"))?
        .next()
        .ok_or_else(|| "the host name has no address".into())
}

fn parse_source(text: &str) -> Result<(String, String), String> {
    text.split_once('=')
        .map(|(camera, source)| (camera.to_owned(), source.to_owned()))
        .ok_or_else(|| "give CAMERA=SOURCE".into())
}

/// Runs until the images end, the user presses Ctrl-C, or the parent ends.
pub(crate) fn run(args: &LocateArgs) -> Result<()> {
    let stop = stop_flag(args.lifeline)?;
    let mut setup = match &args.config {
        Some(path) => LocateSetup::read(path)?,
        None if args.inside_out => {
            LocateSetup::simulated_over_mat(args.pads.clone(), args.seed, "vizflyt")?
        }
        None => LocateSetup::simulated(args.webcams.into(), "vizflyt"),
    };
    if let Some(object) = &args.object {
        setup.object.clone_from(object);
    }
    for (name, source) in &args.sources {
        let Some(camera) = setup.cameras.iter_mut().find(|camera| camera.name == *name) else {
            let known: Vec<&str> =
                setup.cameras.iter().map(|camera| camera.name.as_str()).collect();
            bail!("tags: unknown camera {name:?}; known: {}", known.join(", "));
        };
        camera.source = Some(source.clone());
    }
    let mut locator = Locator::new(setup.cameras.clone(), &setup.layouts, setup.settings.clone())?;
    let live = args.http.map(|address| LiveView::serve(address, &setup.cameras)).transpose()?;
    let view_port = live.as_ref().map(|live| live.address().port());
    let mut sender = PoseSender::open(&args.to, &setup.object, view_port)?;
    let mut sources = Sources::open(&setup, args.truth, &stop)?;
    let page = live.as_ref().map(|live| format!("http://{}", live.address()));
    let names: Vec<&str> = setup.cameras.iter().map(|camera| camera.name.as_str()).collect();
    if args.json {
        let to: Vec<String> = args.to.iter().map(ToString::to_string).collect();
        print_line(json!({
            "ready": "tags", "truth": sources.truth(), "http": page, "cameras": names, "to": to,
        }));
    } else {
        let or_none = |value: Option<&dyn Display>| value.map_or("-".into(), ToString::to_string);
        print_line(format!("cameras     {}", names.join(", ")));
        print_line(format!(
            "truth       {}",
            or_none(sources.truth().as_ref().map(|a| a as &dyn Display))
        ));
        print_line(format!(
            "live view   {}",
            or_none(page.as_ref().map(|page| page as &dyn Display))
        ));
    }
    let mut figures = Figures::default();
    let mut second = Figures::default();
    let mut printed_at = Instant::now();
    let mut faults: Vec<Option<String>> = vec![None; names.len()];
    while !stop.load(Ordering::Relaxed) {
        let Some(shots) = sources.next(WAIT)? else { break };
        while let Some(CameraEvent { camera, fault }) = sources.poll_event() {
            let name = names[camera];
            if args.json {
                print_line(json!({ "camera": name, "fault": fault }));
            } else {
                print_line(format!("{name}: {}", fault.as_deref().unwrap_or("is back")));
            }
            faults[camera] = fault.map(|fault| format!("{name}: {fault}"));
            sender.notes =
                faults.iter().flatten().cloned().chain(findings(&locator, &names)).collect();
        }
        for set in together(&shots) {
            let views: Vec<StampedImage> = set
                .iter()
                .map(|shot| StampedImage {
                    camera: shot.camera,
                    stamp: shot.stamp,
                    image: &shot.image,
                })
                .collect();
            let begun = Instant::now();
            let outcome = locator.handle_images(&views);
            let image_ms = begun.elapsed().as_secs_f64() * 1e3 / views.len() as f64;
            if let Ok(located) = &outcome.located {
                let sent = sender.send(located, image_ms, sources.is_live());
                if args.poses {
                    print_line(sent);
                }
            }
            let off_m = outcome.located.as_ref().ok().and_then(|located| {
                let truth = sources.true_pose(located.stamp)?;
                Some(located.world_from_body.translation_m.distance(truth.translation_m))
            });
            second.note(&outcome, image_ms, off_m);
            if let Some(live) = &live {
                live.show(set, &outcome, image_ms);
            }
        }
        if printed_at.elapsed() >= Duration::from_secs(1) {
            second.seconds = printed_at.elapsed().as_secs_f64();
            printed_at = Instant::now();
            let found = findings(&locator, &names);
            if args.json {
                let mut status = second.to_json();
                status["findings"] = found.clone().into();
                print_line(json!({ "status": status }));
            } else {
                print_line(second.to_line());
                for finding in &found {
                    print_line(format!("  {finding}"));
                }
            }
            sender.notes = faults.iter().flatten().cloned().chain(found).collect();
            figures.add(&std::mem::take(&mut second));
        }
    }
    second.seconds = printed_at.elapsed().as_secs_f64();
    figures.add(&second);
    if args.json {
        let mut report = figures.to_json();
        report["findings"] = findings(&locator, &names).into();
        print_line(json!({ "report": report }));
    } else {
        print_line(format!("total: {}", figures.to_line()));
        for finding in findings(&locator, &names) {
            print_line(format!("  {finding}"));
        }
    }
    Ok(())
}

/// Returns the detected problems of the lab as sentences.
fn findings(locator: &Locator, names: &[&str]) -> Vec<String> {
    locator.findings().iter().map(|finding| finding.words(names)).collect()
}

/// Splits images, which are sorted by stamp, into sets of one instant: a new set starts at a gap in
/// the stamps, or when a camera repeats.
fn together(shots: &[CameraImage]) -> impl Iterator<Item = &[CameraImage]> {
    let mut rest = shots;
    std::iter::from_fn(move || {
        let first = rest.first()?;
        let mut seen = vec![first.camera];
        let end = 1 + rest[1..]
            .iter()
            .take_while(|shot| {
                let same = shot.stamp.seconds_since(first.stamp) <= TOGETHER_S;
                let again = seen.contains(&shot.camera);
                seen.push(shot.camera);
                same && !again
            })
            .count();
        let (set, left) = rest.split_at(end);
        rest = left;
        Some(set)
    })
}

struct PoseSender {
    socket: UdpSocket,
    to: Vec<SocketAddr>,
    object: String,
    /// Port of the live view, for the server's page.
    view_port: Option<u16>,
    /// Notes for users of the server's page.
    notes: Vec<String>,
    seq: std::cell::Cell<u64>,
}

impl PoseSender {
    fn open(to: &[SocketAddr], object: &str, view_port: Option<u16>) -> Result<Self> {
        let any = if to.iter().any(SocketAddr::is_ipv6) { "[::]:0" } else { "0.0.0.0:0" };
        let socket = UdpSocket::bind(any).context("tags: cannot open a socket for poses")?;
        // A full buffer drops a pose; the next one is newer anyway.
        socket.set_nonblocking(true).context("tags: the socket for poses")?;
        let (to, object, notes) = (to.to_vec(), object.into(), Vec::new());
        Ok(Self { socket, to, object, view_port, notes, seq: 0.into() })
    }

    /// Sends a pose, and returns it with stamps of this computer's clock.
    fn send(&self, located: &Located, image_ms: f64, is_live: bool) -> Value {
        self.seq.set(self.seq.get() + 1);
        for &to in &self.to {
            // On the same computer, server and sender have the same clock.
            let clock = if is_live && to.ip().is_loopback() { "server" } else { "sender" };
            let mut packet = packet(&self.object, self.seq.get(), clock, located, image_ms);
            packet["quality"]["view_port"] = self.view_port.into();
            if !self.notes.is_empty() {
                packet["notes"] = self.notes.clone().into();
            }
            // Lost if no server listens, like any datagram.
            let _ = self.socket.send_to(packet.to_string().as_bytes(), to);
        }
        let clock = if is_live { "server" } else { "sender" };
        packet(&self.object, self.seq.get(), clock, located, image_ms)
    }
}

fn packet(object: &str, seq: u64, clock: &str, located: &Located, image_ms: f64) -> Value {
    let pose = &located.world_from_body;
    json!({
        "vizflyt_pose": 1,
        "object": object,
        "seq": seq,
        "stamp_ns": located.stamp.as_ns(),
        "clock": clock,
        "position_m": pose.translation_m.to_array(),
        "rotation_xyzw": pose.rotation.to_array(),
        "position_sigma_m": located.position_sigma_m.to_array(),
        "rotation_sigma_rad": located.rotation_sigma_rad.to_array(),
        "quality": {
            "tags": located.tags,
            "cameras": located.cameras,
            "rms_px": located.rms_px,
            "image_ms": image_ms,
        },
    })
}

/// Counters of one second, or of the whole run.
#[derive(Debug, Default)]
struct Figures {
    seconds: f64,
    images: usize,
    sets: usize,
    located: usize,
    /// Sets without a camera that can see the vehicle, according to its expected position.
    out_of_view: usize,
    /// Sets that are older than an earlier pose.
    late: usize,
    no_tag: usize,
    residuals: usize,
    ambiguous: usize,
    other: usize,
    image_ms: Vec<f64>,
    rms_px: Vec<f64>,
    sigma_mm: Vec<f64>,
    tags: usize,
    off_mm: Vec<f64>,
}

impl Figures {
    fn note(&mut self, outcome: &LocateOutcome, image_ms: f64, off_m: Option<f64>) {
        self.images += outcome.looks.len();
        if outcome.looks.iter().all(|look| look.out_of_view) {
            self.out_of_view += 1;
            return;
        }
        if matches!(outcome.located, Err(Unlocated::Old)) {
            self.late += 1;
            return;
        }
        self.sets += 1;
        self.image_ms.push(image_ms);
        match &outcome.located {
            Ok(located) => {
                self.located += 1;
                self.tags += located.tags;
                self.rms_px.push(located.rms_px);
                self.sigma_mm.push(located.position_sigma_m.length() * 1e3);
                self.off_mm.extend(off_m.map(|m| m * 1e3));
            }
            Err(Unlocated::NoTag) => self.no_tag += 1,
            Err(Unlocated::Residuals(_)) => self.residuals += 1,
            Err(Unlocated::Ambiguous) => self.ambiguous += 1,
            Err(Unlocated::NoPose) => self.other += 1,
            // Counted above.
            Err(Unlocated::Old) => {}
        }
    }

    fn add(&mut self, other: &Self) {
        self.seconds += other.seconds;
        self.images += other.images;
        self.sets += other.sets;
        self.located += other.located;
        self.out_of_view += other.out_of_view;
        self.late += other.late;
        self.no_tag += other.no_tag;
        self.residuals += other.residuals;
        self.ambiguous += other.ambiguous;
        self.other += other.other;
        self.tags += other.tags;
        for (mine, theirs) in [
            (&mut self.image_ms, &other.image_ms),
            (&mut self.rms_px, &other.rms_px),
            (&mut self.sigma_mm, &other.sigma_mm),
            (&mut self.off_mm, &other.off_mm),
        ] {
            mine.extend(theirs);
            // After hours of flight, only the last values are kept for the report.
            let old = mine.len().saturating_sub(MAX_FIGURES);
            mine.drain(..old);
        }
    }

    fn to_json(&self) -> Value {
        let squares = self.off_mm.iter().map(|mm| mm * mm).sum::<f64>();
        let off_mm_rms =
            (!self.off_mm.is_empty()).then(|| (squares / self.off_mm.len() as f64).sqrt());
        json!({
            "seconds": self.seconds,
            "images": self.images,
            "sets": self.sets,
            "located": self.located,
            "out_of_view": self.out_of_view,
            "late": self.late,
            "no_tag": self.no_tag,
            "residuals": self.residuals,
            "ambiguous": self.ambiguous,
            "other": self.other,
            "rate_hz": self.located as f64 / self.seconds.max(1e-9),
            "tags": self.tags as f64 / self.located.max(1) as f64,
            "image_ms_p50": quantile(&self.image_ms, 0.5),
            "image_ms_p99": quantile(&self.image_ms, 0.99),
            "rms_px_p50": quantile(&self.rms_px, 0.5),
            "sigma_mm_p50": quantile(&self.sigma_mm, 0.5),
            "error_mm_rms": off_mm_rms,
            "error_mm_p99": quantile(&self.off_mm, 0.99),
        })
    }

    fn to_line(&self) -> String {
        use std::fmt::Write;
        let number = |value: Option<f64>| value.map_or("-".into(), |v| format!("{v:.2}"));
        let mut line = format!(
            "{:5.1} poses/s  {:3.0} % of {} sets located  {:.1} tags  {} px  sigma {} mm  {} ms an image",
            self.located as f64 / self.seconds.max(1e-9),
            100.0 * self.located as f64 / self.sets.max(1) as f64,
            self.sets,
            self.tags as f64 / self.located.max(1) as f64,
            number(quantile(&self.rms_px, 0.5)),
            number(quantile(&self.sigma_mm, 0.5)),
            number(quantile(&self.image_ms, 0.5)),
        );
        for (count, why) in [
            (self.no_tag, "without a tag"),
            (self.ambiguous, "ambiguous between two poses"),
            (self.residuals, "that fit no pose: check layout, lens and camera's place"),
        ] {
            if count > 0 {
                // Writing to a string does not fail.
                let _ = write!(line, "; {count} {why}");
            }
        }
        line
    }
}

fn quantile(values: &[f64], share: f64) -> Option<f64> {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(((sorted.len() as f64 * share) as usize).min(sorted.len().max(1) - 1)).copied()
}

/// Maximum wait for images before the stop flag is checked.
const WAIT: Duration = Duration::from_millis(100);
/// Exposures closer than this are located together. [s]
const TOGETHER_S: f64 = 0.002;
/// Maximum number of sets for the report's statistics: an hour of two cameras at 30 Hz.
const MAX_FIGURES: usize = 216_000;

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};
    use vizflyt_protocol::geometry::Pose;
    use vizflyt_protocol::time::HostTime;
    use vizflyt_tags::image::Gray;

    use super::*;

    #[test]
    fn splits_images_into_sets_of_one_instant() {
        let shot = |camera, ms: u64| CameraImage {
            camera,
            stamp: HostTime::from_ns(ms * 1_000_000),
            image: Gray::plain(1, 1, 0),
        };
        let check = |cameras: &[(usize, u64)], expected: &[usize]| {
            let shots: Vec<CameraImage> =
                cameras.iter().map(|&(camera, ms)| shot(camera, ms)).collect();
            let sizes: Vec<usize> = together(&shots).map(<[CameraImage]>::len).collect();
            assert_eq!(sizes, expected, "{cameras:?}");
        };
        check(&[], &[]);
        check(&[(0, 5)], &[1]);
        check(&[(0, 5), (1, 6)], &[2]);
        check(&[(0, 5), (1, 8)], &[1, 1]);
        check(&[(0, 5), (0, 6), (1, 6)], &[1, 2]);
        check(&[(0, 5), (1, 7), (2, 8)], &[2, 1]);
    }

    #[test]
    fn sends_poses_that_the_servers_driver_parses() {
        let located = Located {
            stamp: HostTime::from_ns(81_250_000),
            world_from_body: Pose::new(DVec3::new(1.0, -2.0, 0.5), DQuat::from_rotation_z(0.3)),
            position_sigma_m: DVec3::new(0.002, 0.003, 0.004),
            rotation_sigma_rad: DVec3::splat(0.01),
            covariance: [[0.0; 6]; 6],
            tags: 3,
            cameras: 2,
            rms_px: 0.2,
        };
        let text = packet("wasp", 7, "server", &located, 4.0).to_string();
        let read =
            vizflyt_server::poses::drivers::json::PosePacket::parse(text.as_bytes()).unwrap();
        assert_eq!((&*read.object, read.seq, read.stamp_ns), ("wasp", Some(7), Some(81_250_000)));
        assert_eq!(read.position_m, [1.0, -2.0, 0.5]);
        assert_eq!(read.rotation_xyzw, located.world_from_body.rotation.to_array());
        assert_eq!(read.position_sigma_m, Some([0.002, 0.003, 0.004]));
    }

    #[test]
    fn quantile_of_an_empty_list_is_none() {
        assert_eq!(quantile(&[], 0.5), None);
        assert_eq!(quantile(&[3.0], 0.99), Some(3.0));
        assert_eq!(quantile(&[3.0, 1.0, 2.0], 0.5), Some(2.0));
    }
}
