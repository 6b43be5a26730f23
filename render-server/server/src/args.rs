//! Command line of the render server.

use std::net::SocketAddr;
use std::path::PathBuf;

use clap::{Args, ValueHint};
use vizflyt_protocol::messages::Grant;
use vizflyt_rgbd::{ColorMode, DepthBound, DepthMode, EncodeOptions};

use crate::authorization::parse_grant;
use crate::flights::leaderboard::{Database, UnknownDatabase};
use crate::poses::settings::{Driver, LocalizationConfig};
use crate::render::{DetailKind, RendererKind};
use crate::scene::{Antialiased, BareArgs};
use crate::stream::rate_control::Adaptation;
use crate::stream::transport::Congestion;
use crate::web::Login;

/// Render the cameras' view of the twin, and referee the flight
///
/// Example: vizflyt serve forest/arena.toml --vicon 0.0.0.0:51001 --http 127.0.0.1:8080
#[derive(Args, Clone, Debug)]
pub struct ServeArgs {
    /// arena.toml, its folder, or a bare scene file, which gets a default arena
    #[arg(required = false, required_unless_present_any = ["config", "print_config"])]
    pub arena: PathBuf,

    /// File with these settings; options on the command line override it
    ///
    /// Each option is a key of its name, with `_` for `-`.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,

    /// Print the settings in effect as such a file, and exit
    #[arg(long)]
    pub print_config: bool,

    /// Folder of scenes from which the instructor chooses on the page
    ///
    /// Each scene is a folder with an arena.toml.
    #[arg(long, help_heading = "Scene", value_name = "DIR")]
    pub scenes: Option<PathBuf>,

    /// Address for runtimes (UDP)
    #[arg(long, help_heading = "Network", value_name = "ADDR", default_value = "0.0.0.0:4433")]
    pub quic: SocketAddr,

    /// Address of the page; port 0 selects a free one
    #[arg(long, help_heading = "Web page", value_name = "ADDR", default_value = "127.0.0.1:8080")]
    pub http: SocketAddr,

    /// HTTPS for the page: `auto`, or a certificate's PEM file [default: plain HTTP]
    ///
    /// `auto` creates a certificate and stores it with the server's keys. A file also needs --tls-key.
    #[arg(long, help_heading = "Web page", value_name = "auto|CERT", value_hint = ValueHint::FilePath)]
    pub tls: Option<PathBuf>,

    /// PEM file of the private key of --tls CERT
    #[arg(long, help_heading = "Web page", value_name = "FILE", value_hint = ValueHint::FilePath)]
    pub tls_key: Option<PathBuf>,

    /// Serve the page over plain HTTP on a public address too
    ///
    /// Everyone on the network path can then read keys and images.
    #[arg(long, help_heading = "Web page")]
    pub plain_http: bool,

    /// Address for Vicon Tracker's UDP object stream [default: 0.0.0.0:51001]
    ///
    /// The default applies unless arena.toml has [[localization]] or --pose is given.
    #[arg(long, help_heading = "Localization", value_name = "ADDR")]
    pub vicon: Option<SocketAddr>,

    /// Pose source instead of those of arena.toml; may be repeated
    #[arg(long, help_heading = "Localization", value_name = "DRIVER:ADDR[,KEY=VALUE]", long_help = pose_help(), value_parser = LocalizationConfig::parse)]
    pub pose: Vec<LocalizationConfig>,

    /// Name of a vehicle and its object in the localization system; may be repeated
    ///
    /// Default: the [[vehicles]] of arena.toml, else vizflyt.
    #[arg(long = "vehicle", help_heading = "Localization", value_name = "NAME")]
    pub vehicles: Vec<String>,

    /// Renderer: a graphics card if available, the CPU, or any graphics adapter
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "KIND", default_value_t)]
    pub renderer: RendererKind,

    /// Level of detail in large scenes
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub detail: DetailKind,

    /// Memory for the blocks of a packed scene, which is rendered from the disk [MiB]
    #[arg(long, help_heading = "Rendering", value_name = "MIB", default_value_t = 1024, value_parser = clap::value_parser!(u32).range(1..))]
    pub scene_memory: u32,

    /// Whether the scene was trained with anti-aliasing (mip-splatting)
    ///
    /// auto: as set in its arena, else in its file.
    #[arg(long, help_heading = "Rendering", value_enum, value_name = "HOW", default_value_t)]
    pub antialiased: Antialiased,

    /// Maximum render rate [Hz]
    #[arg(long, help_heading = "Rendering", value_name = "HZ", default_value_t = 120.0, value_parser = rate)]
    pub max_rate: f64,

    /// JPEG quality of the colour images, 1 to 100
    #[arg(long, help_heading = "Images", value_name = "Q", default_value_t = 93, value_parser = clap::value_parser!(u8).range(1..=100))]
    pub quality: u8,

    /// Compression of colour
    #[arg(long, help_heading = "Images", value_enum, default_value_t)]
    pub color: Color,

    /// Compression of depth; both are exact
    #[arg(long, help_heading = "Images", value_enum, default_value_t)]
    pub depth: Depth,

    /// Maximum depth error K z², but at least 1 mm [default: exact]
    ///
    /// Saves half of the bytes or more; K = 0.001 is 25 mm at 5 m.
    #[arg(long, help_heading = "Images", value_name = "K", value_parser = depth_bound)]
    pub depth_error: Option<DepthBound>,

    /// Congestion control of the image stream
    #[arg(long, help_heading = "Network", value_enum, default_value_t)]
    pub congestion: Congestion,

    /// Image properties that may be reduced for a slow link
    ///
    /// Quality is reduced before rate, and rate before size.
    #[arg(long, help_heading = "Network", value_enum, default_value_t)]
    pub adapt: Adaptation,

    /// Placement of a scene without an arena
    #[command(flatten)]
    pub bare: BareArgs,

    /// Isolate the vehicles: they neither see each other nor collide
    #[arg(long, help_heading = "Scene")]
    pub apart: bool,

    /// Seed for the initial phase of objects that set none in arena.toml
    #[arg(long, help_heading = "Scene", value_name = "N", default_value_t = 0)]
    pub seed: u64,

    /// Open a pairing at the start and print its code: `instructor`, or `team:VEHICLE`
    #[arg(long, help_heading = "Network", value_name = "ROLE", value_parser = parse_grant)]
    pub pair: Option<Grant>,

    /// Print the page's addresses with keys, for other computers
    ///
    /// They are always printed if --http is not only this computer.
    #[arg(long, help_heading = "Web page")]
    pub print_page_keys: bool,

    /// Users that must log in on the page
    ///
    /// `vizflyt password` sets the instructor's password.
    #[arg(long, help_heading = "Web page", value_enum, default_value_t)]
    pub login: Login,

    /// Folder of this server's key and of paired.toml, the list of paired computers
    ///
    /// Default: $XDG_CONFIG_HOME/vizflyt or ~/.config/vizflyt.
    #[arg(long, help_heading = "Network", value_name = "DIR")]
    pub keys: Option<PathBuf>,

    /// Database of flights: a file, postgres://USER:PASSWORD@HOST/NAME, or none
    ///
    /// Default: $XDG_DATA_HOME/vizflyt/leaderboard.sqlite or ~/.local/share/vizflyt/leaderboard.sqlite.
    #[arg(long, help_heading = "Leaderboard", value_name = "FILE|URL|none", value_parser = run_storage, value_hint = ValueHint::FilePath)]
    pub leaderboard: Option<RunStorage>,

    /// Maximum of a team's official runs on a course; further runs are practice
    ///
    /// Default: unlimited.
    #[arg(long, help_heading = "Leaderboard", value_name = "N")]
    pub official_attempts: Option<u32>,

    /// File of the lab day with its checks and queue, or none
    ///
    /// Default: lab-day.json next to the leaderboard's file; none without a leaderboard.
    #[arg(long, help_heading = "Leaderboard", value_name = "FILE|none", value_parser = lab_storage, value_hint = ValueHint::FilePath)]
    pub lab_day: Option<LabStorage>,

    /// Print JSON lines on standard output: ready, events, report
    #[arg(long, help_heading = "Output")]
    pub json: bool,

    /// Exit when standard input closes
    #[arg(long, hide = true)]
    pub lifeline: bool,
}

/// Storage of runs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RunStorage {
    In(Database),
    Nowhere,
}

fn run_storage(text: &str) -> Result<RunStorage, UnknownDatabase> {
    if text == "none" { Ok(RunStorage::Nowhere) } else { text.parse().map(RunStorage::In) }
}

/// Storage of the lab day.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LabStorage {
    In(PathBuf),
    Nowhere,
}

#[allow(clippy::unnecessary_wraps)] // Why: clap's value parsers return a Result.
fn lab_storage(text: &str) -> Result<LabStorage, String> {
    Ok(if text == "none" { LabStorage::Nowhere } else { LabStorage::In(text.into()) })
}

/// Compression of colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Color {
    /// JPEG with colour at full resolution
    #[default]
    #[value(name = "444")]
    Jpeg444,
    /// JPEG with colour at half resolution: a quarter smaller, bleeds at edges
    #[value(name = "420")]
    Jpeg420,
    /// Lossless: three times the size, 15 ms at 640x480
    Lossless,
}

/// Compression of depth.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Depth {
    /// Under a millisecond at 640x480
    #[default]
    Fast,
    /// A sixth smaller, 5 ms
    Small,
}

impl ServeArgs {
    /// Returns the pose sources: those of the command line, else those of `arena.toml`, else Vicon.
    pub fn localization(&self, arena: Vec<LocalizationConfig>) -> Vec<LocalizationConfig> {
        let vicon = self.vicon.map(|address| LocalizationConfig {
            address: Some(address.to_string()),
            ..LocalizationConfig::new(Driver::Vicon)
        });
        let given: Vec<_> = vicon.into_iter().chain(self.pose.clone()).collect();
        let vicon = || vec![LocalizationConfig::new(Driver::Vicon)];
        [given, arena].into_iter().find(|sources| !sources.is_empty()).unwrap_or_else(vicon)
    }

    /// Returns the file of the lab day; `None` if disabled.
    pub fn lab_day_file(&self) -> Option<PathBuf> {
        let runs = match (&self.lab_day, &self.leaderboard) {
            (Some(LabStorage::In(file)), _) => return Some(file.clone()),
            (Some(LabStorage::Nowhere), _) | (None, Some(RunStorage::Nowhere)) => return None,
            (None, Some(RunStorage::In(Database::File(file)))) => file.clone(),
            (None, _) => Database::default_file()?,
        };
        Some(runs.with_file_name("lab-day.json"))
    }

    /// Returns the options of the image encoder.
    pub fn encode_options(&self) -> EncodeOptions {
        EncodeOptions {
            jpeg_quality: self.quality,
            color_mode: match self.color {
                Color::Jpeg444 => ColorMode::Jpeg444,
                Color::Jpeg420 => ColorMode::Jpeg420,
                Color::Lossless => ColorMode::Lossless,
            },
            depth_mode: match self.depth {
                Depth::Fast => DepthMode::Fast,
                Depth::Small => DepthMode::Small,
            },
            depth_bound: self.depth_error,
            ..EncodeOptions::default()
        }
    }
}

/// Returns the help of `--pose`, with the names of all drivers.
fn pose_help() -> String {
    format!(
        "Pose source instead of arena.toml's: {}, with the keys of [[localization]], for example \
         natnet:239.255.42.99:1511,up=y or 'vicon,pivot_m=[0.02,0,0.05]'; may be repeated",
        Driver::names()
    )
}

fn depth_bound(text: &str) -> Result<DepthBound, String> {
    let k_per_m = number(text, 1e-6, 0.1)?;
    DepthBound::new(k_per_m).ok_or_else(|| format!("{k_per_m} is outside 0.000001 to 0.1"))
}

/// Parses `--max-rate`. [Hz]
///
/// # Errors
/// Text that is not a rate from 1 to 1000.
pub fn rate(text: &str) -> Result<f64, String> {
    number(text, 1.0, 1000.0)
}

fn number(text: &str, least: f64, most: f64) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("'{text}' is not a number"))?;
    if (least..=most).contains(&value) {
        Ok(value)
    } else {
        Err(format!("{value} is outside {least} to {most}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use vizflyt_arena::config::Up;
    use vizflyt_protocol::messages::bounded;

    #[derive(Parser)]
    struct Cli {
        #[command(flatten)]
        serve: ServeArgs,
    }

    fn parse(words: &str) -> Result<ServeArgs, String> {
        let words = std::iter::once("x").chain(words.split_whitespace());
        Cli::try_parse_from(words).map(|cli| cli.serve).map_err(|error| error.to_string())
    }

    #[test]
    fn options_are_parsed_and_checked() {
        let args =
            parse("room.ply --up -y --scale 0.2 --quic 127.0.0.1:0 --congestion bbr").unwrap();
        assert_eq!(args.bare, BareArgs { up: Some(Up::NegY), scale: Some(0.2) });
        assert_eq!((args.congestion, args.adapt), (Congestion::Bbr, Adaptation::Auto));
        assert_eq!(parse("a.toml --adapt none").unwrap().adapt, Adaptation::None);
        assert_eq!(args.encode_options(), EncodeOptions::default());
        let args = parse("a.toml --color 420 --depth small --depth-error 0.002").unwrap();
        let options = args.encode_options();
        assert_eq!(
            (options.color_mode, options.depth_mode),
            (ColorMode::Jpeg420, DepthMode::Small)
        );
        assert_eq!(options.depth_bound, DepthBound::new(0.002));
        assert_eq!(parse("a.toml --up z").unwrap().bare.up, Some(Up::Z));
        assert_eq!(parse("a.toml --pair instructor").unwrap().pair, Some(Grant::Instructor));
        let team = Grant::Team { vehicles: ["ant", "bee"].map(bounded).into_iter().collect() };
        assert_eq!(parse("a.toml --pair team:ant,bee").unwrap().pair, Some(team));
        let sources = |words: &str, arena: &[&str]| {
            let arena = arena.iter().map(|text| LocalizationConfig::parse(text).unwrap());
            let given = parse(words).unwrap().localization(arena.collect());
            given.iter().map(|s| format!("{}:{}", s.driver, s.address())).collect::<Vec<_>>()
        };
        assert_eq!(sources("a.toml", &[]), ["vicon:0.0.0.0:51001"]);
        assert_eq!(sources("a.toml", &["natnet"]), ["natnet:239.255.42.99:1511"]);
        let both = sources("a.toml --pose json:0.0.0.0:7 --vicon 0.0.0.0:8", &["natnet"]);
        assert_eq!(both, ["vicon:0.0.0.0:8", "json:0.0.0.0:7"]);
        for wrong in [
            "a.toml --pose radio",
            "a.toml --max-rate nan",
            "a.toml --max-rate 0",
            "a.toml --quality 0",
            "a.toml --scale -1",
            "a.toml --depth-error 0",
            "a.toml --depth-error 0.2",
            "a.toml --color 422",
            "a.toml --pair boss",
            "a.toml --pair team:",
            "a.toml --pair team:a,b,c,d,e,f,g,h,i",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
        assert!(parse("a.toml --max-rate 0").unwrap_err().contains("outside 1 to 1000"));
    }
}
