//! The simulated lab: render server, runtime and simulator as processes on this machine. Started by
//! `vizflyt demo` and `vizflyt fly`.
//!
//! ```text
//! prepare   generate (or find) the scene: scene.ply, arena.toml, truth.json
//! keys      pair server and runtime, for this flight only
//! serve     start the render server; it reports its ports
//! fly       start the runtime with the plugin; it reports its MAVLink port
//! bridge    start the Wi-Fi bridge, if enabled; it reports its serial port
//! tags      start AprilTag localization, if enabled; it reports its address for true poses
//! sim       start the vehicle: airframe, autopilot, mocap
//! watch     print events and status, until the runtime ends (or the user presses Ctrl-C)
//! report    join the measurements of the three
//! ```
//! All are real processes that communicate over UDP, QUIC and shared memory. This process only
//! starts them, reads their output, and stops them.

mod child;
mod inbox;
mod keys;
mod localization;
mod memory;
mod report;

use std::ffi::OsString;
use std::net::{SocketAddr, TcpListener};
use std::os::unix::process::ExitStatusExt;
use std::path::Path;
use std::sync::mpsc::{self, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use clap::Args;
use nix::sys::signal::Signal;
use serde::Deserialize;
use serde_json::{Value, json};
use vizflyt_process::{on_interrupt, open_browser, print_line};
use vizflyt_runtime::args::LogArgs;
use vizflyt_runtime::console::{Screen, Status};
use vizflyt_scenes::projects::{self, CourseProject, Level, NoProject};
use vizflyt_scenes::{SceneKind, Variant};
use vizflyt_server::render::{DetailKind, RendererKind};
use vizflyt_server::scene::{Antialiased, BareArgs};
use vizflyt_simulator::imu::ImuModel;
use vizflyt_studio::stage::{Place, Stage};

use self::child::{Child, Notice, Role};
use self::inbox::Inbox;
use self::keys::Keys;
use self::localization::Localization;
use self::memory::MemoryWatch;
pub(crate) use self::report::LabReport;
use self::report::Parts;

/// Options of the simulated lab.
#[derive(Args, Clone, Debug, Default)]
pub(crate) struct LabArgs {
    #[arg(long, help_heading = "Scene", help = format!(
        "Scene: {}; or the path of a scene or arena.toml", SceneKind::names()
    ), long_help = format!(
        "Scene: {}; or the path of a scene folder, an arena.toml or a scene file [default: forest; room with \
         --localization tags or mat]", SceneKind::names()
    ))]
    pub scene: Option<String>,
    #[arg(long, help_heading = "Scene", value_name = "NAME|FILE", value_parser = project_name, help = format!(
        "Project: {}; or FILE.toml", projects::NAMES.join(", ")
    ), long_help = format!(
        "Course project, with its scene, sensors and rules: {}; or a file FILE.toml; replaces --scene",
        projects::NAMES.join(", ")
    ))]
    pub project: Option<String>,
    /// Level of the project: ug (with depth) or g (without depth) [default: ug]
    #[arg(long, help_heading = "Scene", value_name = "LEVEL", requires = "project")]
    pub level: Option<Level>,
    /// Light and weather of the project [default: day]
    #[arg(long, help_heading = "Scene", value_name = "NAME", requires = "project", long_help = format!(
        "Light and weather of the project: {} [default: day]", Variant::names()
    ))]
    pub variant: Option<Variant>,
    /// Light and weather of a generated scene or a scene file [default: day]
    #[arg(long, help_heading = "Scene", value_name = "NAME", conflicts_with = "project", long_help = format!(
        "Light and weather of a generated scene or a scene file: {} [default: day]", Variant::names()
    ))]
    pub environment: Option<Variant>,
    #[command(flatten)]
    pub bare: BareArgs,
    /// Seed of the generated scene and of the simulator's noise [default: 7]
    #[arg(long, help_heading = "Scene")]
    pub seed: Option<u64>,
    /// Localization of the vehicle: simulated motion capture or AprilTags
    #[arg(long, help_heading = "Localization", value_enum, value_name = "HOW", default_value_t)]
    pub localization: Localization,
    /// Also send the vehicle's true pose to this address, to measure localization
    ///
    /// As in `vizflyt sim --truth-to`.
    #[arg(long, help_heading = "Localization", value_name = "ADDR:PORT")]
    pub truth_to: Option<SocketAddr>,
    #[arg(long, help_heading = "Vehicle", value_name = "NAME", default_value_t, help = format!(
        "Inertial sensor: {}", ImuModel::names()
    ), long_help = format!(
        "Simulated inertial sensor, with the noise of its data sheet; frame: with the vibration of a small frame: {}",
        ImuModel::names()
    ))]
    pub imu: ImuModel,
    /// Start-up times of a real autopilot, as in `vizflyt sim --realistic-startup`
    #[arg(long, help_heading = "Vehicle")]
    pub realistic_startup: bool,
    /// Route all MAVLink bytes through the vehicle's Wi-Fi bridge, emulated here
    #[arg(long, help_heading = "Vehicle")]
    pub through_bridge: bool,
    /// Renderer: usable graphics card, processor, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    pub renderer: RendererKind,
    /// Level of detail for large scenes
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub detail: DetailKind,
    /// Whether the scene was trained with anti-aliasing (mip-splatting)
    ///
    /// auto: as in the arena, or else as in the scene's file.
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub antialiased: Antialiased,
    /// Maximum render rate [Hz] [default: 120]
    #[arg(long, help_heading = "Rendering", value_name = "HZ", value_parser = vizflyt_server::args::rate)]
    pub max_rate: Option<f64>,
    /// Open no browser
    #[arg(long, help_heading = "Web page")]
    pub headless: bool,
    /// Port of the page; 0: port 8377, or a free one if it is in use
    ///
    /// A browser stores flights by address, so it finds them again at the same port.
    #[arg(long, help_heading = "Web page", default_value_t = 0)]
    pub port: u16,
}

impl LabArgs {
    /// Returns the address of the page: the usual port if the page opens in a browser and the port
    /// is free.
    fn page_address(&self) -> String {
        let is_usual = self.port == 0
            && !self.headless
            && TcpListener::bind(("127.0.0.1", USUAL_PORT)).is_ok();
        format!("127.0.0.1:{}", if is_usual { USUAL_PORT } else { self.port })
    }

    /// Returns the project's name, else the scene's name or path.
    pub(crate) fn scene(&self) -> &str {
        if let Some(project) = &self.project {
            return project;
        }
        // The forest is larger than the area of the two webcams and of the mat.
        let default = if self.localization.is_by_tags() { "room" } else { "forest" };
        self.scene.as_deref().unwrap_or(default)
    }

    /// Returns the project of the course, if one is flown.
    pub(crate) fn project(&self) -> Option<CourseProject> {
        self.project.as_deref().and_then(|name| CourseProject::find(name).ok())
    }

    /// Returns the project's level.
    pub(crate) fn level(&self) -> Level {
        self.level.unwrap_or_default()
    }

    /// Returns the project's light.
    pub(crate) fn variant(&self) -> Variant {
        self.variant.unwrap_or_default()
    }

    /// Returns the place of the flight.
    fn place(&self) -> Place<'_> {
        Place {
            scene: self.scene(),
            project: self.project(),
            level: self.level.unwrap_or_default(),
            variant: self.variant.unwrap_or_default(),
            environment: self.environment,
            bare: self.bare,
            seed: self.seed(),
        }
    }

    /// Returns the seed.
    pub(crate) fn seed(&self) -> u64 {
        self.seed.unwrap_or(Place::SEED)
    }
}

fn project_name(name: &str) -> Result<String, NoProject> {
    CourseProject::find(name).map(|_| name.to_owned())
}

/// A flight in the simulated lab.
#[derive(Debug)]
pub(crate) struct LabFlight<'a> {
    pub lab: &'a LabArgs,
    /// Plugin and other arguments of `vizflyt fly`.
    pub fly: Vec<OsString>,
    /// Arguments for the plugin.
    pub plugin_arguments: &'a [OsString],
    /// Options of the flight log.
    pub log: &'a LogArgs,
    /// Whether to print the runtime's JSON lines instead of text.
    pub json: bool,
    /// Log level of the children.
    pub log_level: &'a str,
}

/// Returns a note if `scene` names a generated scene while `folder` has an arena of the same name.
fn same_name_note(scene: &str, folder: &Path) -> Option<String> {
    let kind: SceneKind = scene.parse().ok()?;
    folder.join(scene).join("arena.toml").is_file().then(|| {
        format!("generated; the folder of this name is not used: for it, give --scene ./{kind}")
    })
}

/// Flies until the end; returns `None` if the user ends it first.
///
/// # Errors
/// If the lab cannot be started. Failures in flight are outcomes in the report.
pub(crate) fn fly(flight: &LabFlight<'_>) -> Result<Option<LabReport>> {
    let memory = MemoryWatch::start();
    let (notices, inbox) = mpsc::channel();
    let interrupted = notices.clone();
    on_interrupt(move || interrupted.send(Notice::Interrupted).is_ok())?;
    let (scene, seed) = (flight.lab.scene(), flight.lab.seed());
    let stage = Stage::prepare(&flight.lab.place())?;
    flight.lab.localization.check(stage.fence_m)?;
    if !flight.json {
        print_line(format!("scene       {scene}{}", stage.seeded(seed)));
        if flight.lab.scene.is_some()
            && flight.lab.project.is_none()
            && let Some(note) = same_name_note(scene, Path::new(""))
        {
            print_line(format!("            {note}"));
        }
        if let Some(project) = flight.lab.project() {
            let (level, variant) = (flight.lab.level(), flight.lab.variant());
            print_line(format!("project     {}: level {level}, {variant}", project.title()));
        }
    }
    let keys = Keys::make()?;
    let mut show = Show {
        log_level: format!("--log-level={}", flight.log_level).into(),
        notices,
        inbox: Inbox::new(inbox),
        children: Vec::new(),
        parts: Parts::default(),
        json: flight.json,
        screen: Screen::default(),
    };
    let result = show.fly(flight, &stage, &keys);
    show.end();
    match result? {
        LabEnd::To { log } => Ok(Some(show.parts.join(seed, memory.peak_mb(), &log))),
        LabEnd::Interrupted => {
            if !flight.json {
                print_line("ended on request");
            }
            Ok(None)
        }
    }
}

/// Timeout until a child is ready: large scenes take long to load and bake.
const READY_LIMIT: Duration = Duration::from_mins(2);
/// Timeout for the end of all children together.
const END_LIMIT: Duration = Duration::from_millis(1500);

/// End of the flight part.
enum LabEnd {
    /// The runtime ended; the log is complete.
    To { log: String },
    /// The user ended it.
    Interrupted,
}

/// Default port of the page. It is fixed because a browser stores data by address.
const USUAL_PORT: u16 = 8377;

/// Running children and their reports.
struct Show {
    /// Option that passes the log level to the children.
    log_level: OsString,
    notices: Sender<Notice>,
    inbox: Inbox,
    children: Vec<(Role, Child)>,
    parts: Parts,
    json: bool,
    screen: Screen,
}

impl Show {
    fn fly(&mut self, flight: &LabFlight<'_>, stage: &Stage, keys: &Keys) -> Result<LabEnd> {
        let lab = flight.lab;
        let page = lab.page_address();
        // Checked here because the server's message would name its own option, not --port.
        if let Err(error) = TcpListener::bind(&page) {
            bail!(
                "port {} of the page: {error}; give another --port, or 0 for a free one",
                lab.port
            );
        }
        let mut serve: Vec<OsString> = vec![
            "serve".into(),
            stage.arena.clone().into(),
            keys.option(),
            "--json".into(),
            "--lifeline".into(),
            // Simulated flights do not count for the leaderboard.
            "--leaderboard=none".into(),
            "--quic=127.0.0.1:0".into(),
            lab.localization.of_server(),
            // Only the simulator's vehicle, even if the arena lists others.
            "--vehicle=vizflyt".into(),
            format!("--http={page}").into(),
            format!("--renderer={}", lab.renderer).into(),
            format!("--detail={}", lab.detail).into(),
            format!("--antialiased={}", lab.antialiased).into(),
            self.log_level.clone(),
        ];
        serve.extend(lab.max_rate.map(|rate| format!("--max-rate={rate}").into()));
        let Some(server) = self.start(Role::Server, &serve)? else {
            return Ok(LabEnd::Interrupted);
        };
        let url = text(&server, "http")?;
        if self.json {
            print_line(json!({"ready": "lab", "http": url}));
        } else {
            print_line(format!(
                "renderer    {} ({})",
                text(&server, "renderer")?,
                text(&server, "renderer_reason")?
            ));
            print_line(format!("page        {url}"));
        }
        if !lab.headless {
            open_browser(&url);
        }

        keys.note_server(&text(&server, "quic")?)?;
        let mut fly: Vec<OsString> = vec!["fly".into()];
        fly.extend(flight.fly.iter().cloned());
        fly.extend([
            "--json".into(),
            "--lifeline".into(),
            format!("--server={}", text(&server, "quic")?).into(),
            keys.option(),
            "--mavlink=udpin:127.0.0.1:0".into(),
            "--vehicle=vizflyt".into(),
            self.log_level.clone(),
        ]);
        fly.extend(flight.log.to_command_line());
        if let Some(map) = &stage.map {
            fly.push(format!("--map={}", map.display()).into());
        }
        if !flight.plugin_arguments.is_empty() {
            fly.push("--".into());
            fly.extend(flight.plugin_arguments.iter().cloned());
        }
        let Some(runtime) = self.start(Role::Runtime, &fly)? else {
            return Ok(LabEnd::Interrupted);
        };

        let mavlink = text(&runtime, "mavlink")?;
        let vehicle = if lab.through_bridge {
            let bridge: Vec<OsString> = vec![
                "bridge".into(),
                "emulate".into(),
                "--json".into(),
                "--lifeline".into(),
                "--listen=127.0.0.1:0".into(),
                format!("--client={mavlink}").into(),
                self.log_level.clone(),
            ];
            let Some(bridge) = self.start(Role::Bridge, &bridge)? else {
                return Ok(LabEnd::Interrupted);
            };
            format!("--serial={}", text(&bridge, "uart")?)
        } else {
            format!("--mavlink=udpout:{mavlink}")
        };
        let poses = server["pose"][0]["address"].as_str();
        let poses = poses.with_context(|| format!("the ready line {server} has no pose"))?;
        let seen = if lab.localization.is_by_tags() {
            let mut tags = lab.localization.of_tags(poses, &stage.pads, lab.seed());
            tags.push(self.log_level.clone());
            let Some(tags) = self.start(Role::Tags, &tags)? else {
                return Ok(LabEnd::Interrupted);
            };
            if !self.json {
                print_line(format!("tags        {}", text(&tags, "http")?));
            }
            format!("--truth-to={}", text(&tags, "truth")?)
        } else {
            lab.localization.of_simulator(poses)
        };
        let mut sim: Vec<OsString> = vec![
            "sim".into(),
            "--airframe".into(),
            "--json".into(),
            "--lifeline".into(),
            vehicle.into(),
            seen.into(),
            format!("--spawn={}", stage.spawn).into(),
            format!("--seed={}", lab.seed()).into(),
            format!("--imu={}", lab.imu).into(),
            self.log_level.clone(),
        ];
        sim.extend(lab.realistic_startup.then(|| "--realistic-startup".into()));
        sim.extend(lab.truth_to.map(|to| OsString::from(format!("--truth-to={to}"))));
        if let Some(truth) = &stage.truth {
            sim.push("--truth".into());
            sim.push(truth.clone().into());
        }
        if self.start(Role::Simulator, &sim)?.is_none() {
            return Ok(LabEnd::Interrupted);
        }
        if self.watch() {
            Ok(LabEnd::To { log: text(&runtime, "log").unwrap_or_default() })
        } else {
            Ok(LabEnd::Interrupted)
        }
    }

    /// Starts a child and returns its `ready` line; `None` if the user ends the flight meanwhile.
    fn start(&mut self, role: Role, args: &[OsString]) -> Result<Option<Value>> {
        let child = Child::start(role, args, &self.notices)?;
        self.children.push((role, child));
        self.inbox.child_started();
        let deadline = Instant::now() + READY_LIMIT;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            match self.inbox.recv_timeout(left) {
                Ok(Notice::Line(from, line)) if from == role && line["ready"].is_string() => {
                    return Ok(Some(line));
                }
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(from)) if from == role => {
                    bail!("the {} ended before it was ready; see its message above", role.name())
                }
                Ok(Notice::Closed(from)) => {
                    bail!(
                        "the {} ended while the {} started; see its message above",
                        from.name(),
                        role.name()
                    )
                }
                Ok(Notice::Interrupted) => return Ok(None),
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    bail!(
                        "the {} was not ready within {} s; close other programs, or use a smaller scene",
                        role.name(),
                        READY_LIMIT.as_secs()
                    )
                }
            }
        }
    }

    /// Prints events until the runtime ends; returns false if the user ends the flight first.
    fn watch(&mut self) -> bool {
        loop {
            match self.inbox.recv() {
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(Role::Runtime)) => return true,
                // The runtime detects a dead server or vehicle, and lands.
                Ok(Notice::Closed(from)) => {
                    self.screen.line(&format!("            the {} has ended", from.name()));
                }
                Ok(Notice::Interrupted) | Err(_) => return false,
            }
        }
    }

    /// Stores a child's report, or prints its event or status.
    fn note(&mut self, from: Role, line: &Value) {
        if let Some(report) = line.get("report") {
            *match from {
                Role::Server => &mut self.parts.server,
                Role::Runtime => &mut self.parts.runtime,
                Role::Simulator => &mut self.parts.simulator,
                Role::Bridge => &mut self.parts.bridge,
                Role::Tags => &mut self.parts.localization,
            } = report.clone();
        }
        // The server repeats the runtime's events for its page: print each only once.
        if from != Role::Runtime {
            return;
        }
        if self.json {
            // The report is printed later, joined.
            if line.get("report").is_none() {
                print_line(line);
            }
        } else if let Some(sentence) = line["event"]["text"].as_str() {
            self.screen.event(&format!("            {sentence}"));
        } else if let (Some(tick), Some(text)) =
            (line["plugin"]["tick"].as_u64(), line["plugin"]["line"].as_str())
        {
            self.screen.line(&format!("            tick {tick} | {text}"));
        } else if let Ok(status) = Status::deserialize(&line["status"]) {
            self.screen.status(&status);
        }
    }

    /// Stops all children and stores the reports that they print at the end.
    fn end(&mut self) {
        self.screen.end();
        let deadline = Instant::now() + END_LIMIT;
        for (_, child) in &mut self.children {
            child.ask_to_end();
        }
        for (role, child) in &mut self.children {
            let signal = child.wait_until(deadline).and_then(|status| status.signal());
            if let Some(Ok(signal)) = signal.map(Signal::try_from) {
                self.parts.killed.push((*role, signal));
            }
        }
        // Each child's reader closes after the last line, so this loop ends.
        while self.inbox.open() > 0 {
            match self.inbox.recv_timeout(END_LIMIT) {
                Ok(Notice::Line(from, line)) => self.note(from, &line),
                Ok(Notice::Closed(_) | Notice::Interrupted) => {}
                Err(_) => break,
            }
        }
    }
}

/// Returns a text field of a `ready` line.
fn text(ready: &Value, key: &str) -> Result<String> {
    ready[key]
        .as_str()
        .map(str::to_owned)
        .with_context(|| format!("the ready line {ready} has no '{key}'"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn notes_a_folder_that_a_generated_scene_hides() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(same_name_note("forest", folder.path()), None);
        std::fs::create_dir(folder.path().join("forest")).unwrap();
        std::fs::write(folder.path().join("forest/arena.toml"), "").unwrap();
        let note = same_name_note("forest", folder.path()).unwrap();
        assert!(note.ends_with("give --scene ./forest"), "{note}");
        assert_eq!(same_name_note("./forest", folder.path()), None);
    }
}
