//! `vizflyt stats`: image age by stage, image delivery, and connection quality, from a running
//! server or a flight's log.

use std::fmt::Write as _;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use vizflyt_arena::pose::{PoseQuality, Rejects};
use vizflyt_process::{OutputStream, print_text};
use vizflyt_protocol::messages::{
    Arrivals, ClockState, INTERVAL_EDGES_MS, Intervals, Stage, StageTimes, Timing,
};
use vizflyt_server::stream::connection::Connection;
use vizflyt_server::stream::delivery::Delivery;
use vizflyt_server::web::VehicleStats;

use crate::server_page::ServerPage;

/// Show the latency of images by stage, and why images were skipped
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:\n  vizflyt stats --watch\n  \
                        vizflyt stats --page http://192.168.10.2:8080 --vehicle wasp --json\n  \
                        vizflyt stats flights/2026-11-21T04-09-21.123Z.mcap\n\n\
                        The stages are explained in docs/guides/timing.md.")]
pub(crate) struct StatsArgs {
    /// Log of a flight; without it, a running server is queried
    #[arg(value_name = "FLIGHT.mcap", conflicts_with_all = ["page", "vehicle", "watch"])]
    flight: Option<PathBuf>,
    /// Address of the server's page
    #[arg(long, value_name = "URL", default_value = "http://127.0.0.1:8080")]
    page: String,
    /// Name of the vehicle [default: the first of the server]
    #[arg(long, value_name = "NAME")]
    vehicle: Option<String>,
    /// Print the statistics as JSON
    #[arg(long)]
    json: bool,
    /// Print the statistics every second
    #[arg(long)]
    watch: bool,
}

/// Runs `vizflyt stats`.
pub(crate) fn run(args: &StatsArgs) -> Result<ExitCode> {
    if let Some(path) = &args.flight {
        let timing = vizflyt_runtime::log::read_timing(path)
            .with_context(|| format!("cannot read {}", path.display()))?
            .with_context(|| {
                format!(
                    "{} has no /timing records: an older runtime wrote it, or the flight \
                     had no images",
                    path.display()
                )
            })?;
        let text = if args.json {
            serde_json::to_string_pretty(&timing)? + "\n"
        } else {
            format!("{}\n\n{}", path.display(), of_timing(&timing, true))
        };
        print_text(OutputStream::Out, text.as_bytes());
        return Ok(ExitCode::SUCCESS);
    }
    loop {
        let text = if args.json { ask(args)? } else { of_vehicle(&parse(&ask(args)?)?)? };
        if args.watch && std::io::stdout().is_terminal() {
            // Move the cursor home and clear the screen.
            print_text(OutputStream::Out, b"\x1b[H\x1b[J");
        }
        print_text(OutputStream::Out, text.as_bytes());
        if !args.watch {
            return Ok(ExitCode::SUCCESS);
        }
        std::thread::sleep(Duration::from_secs(1));
    }
}

/// Returns the server's reply as one line of JSON.
fn ask(args: &StatsArgs) -> Result<String> {
    let query = args.vehicle.as_ref().map_or_else(String::new, |name| {
        name.bytes().fold("?vehicle=".to_owned(), |mut query, byte| {
            // Why: writing to a String cannot fail.
            let _ = if byte.is_ascii_alphanumeric() || b"-._~".contains(&byte) {
                write!(query, "{}", char::from(byte))
            } else {
                write!(query, "%{byte:02X}")
            };
            query
        })
    });
    let (status, body) = ServerPage::at(&args.page).get(&format!("/api/stats{query}"))?;
    let body = String::from_utf8_lossy(&body).into_owned();
    match status {
        200 => Ok(body + "\n"),
        404 if body.is_empty() => {
            bail!(
                "{} has no /api/stats: it is not a VizFlyt server, or an older version",
                args.page
            )
        }
        status => bail!("{}: {body} (HTTP status {status})", args.page),
    }
}

fn parse(json: &str) -> Result<VehicleStats> {
    serde_json::from_str(json)
        .context("cannot parse the server's reply; does it have another version?")
}

/// Returns the statistics of a flying vehicle as text.
fn of_vehicle(answer: &VehicleStats) -> Result<String> {
    let Some(runtime) = &answer.runtime else {
        bail!(
            "no runtime flies '{}': no statistics; start one with `vizflyt fly`, or read the \
             log of a flight with `vizflyt stats FLIGHT.mcap`",
            answer.vehicle
        );
    };
    let mut out = format!("{}, flown by {runtime}\n\n", answer.vehicle);
    match &answer.timing {
        Some(timing) => out += &of_timing(timing, false),
        None => out += "no report of the runtime yet; it reports once a second\n",
    }
    out += "\nimages      of this flight\n";
    for camera in &answer.images {
        out += &of_account(&camera.camera, &camera.account);
    }
    if let Some(connection) = &answer.connection {
        out += &of_connection(connection);
    }
    out += &of_pose(&answer.pose);
    Ok(out)
}

/// Returns the quality of the localization as text.
fn of_pose(pose: &PoseQuality) -> String {
    let Some(age_ms) = pose.age_ms else { return "\npose        none yet\n".to_owned() };
    let mut out = format!(
        "\npose        {:.0} Hz, {age_ms:.0} ms old; within {:.1} mm and {:.2} degrees (one sigma); \
         {} IMU\n",
        pose.rate_hz,
        pose.position_sigma_mm,
        pose.rotation_sigma_deg,
        if pose.imu { "with" } else { "without" },
    );
    for source in &pose.sources {
        let name = if source.name.is_empty() {
            format!("source {}", source.source)
        } else {
            source.name.clone()
        };
        let _ = writeln!(
            out,
            "  {name}: {:.0} Hz, {:.1} ms late, {} accepted, {} rejected{}",
            source.rate_hz,
            source.latency_ms,
            source.accepted,
            source.rejected.total(),
            of_rejects(&source.rejected)
        );
    }
    out
}

/// Returns the reasons for rejections, in brackets.
fn of_rejects(rejects: &Rejects) -> String {
    let Rejects { invalid, stale, clock, outlier, jump, flip, frozen, disagree } = *rejects;
    let reasons = [
        (invalid, "no pose"),
        (stale, "not newer"),
        (clock, "wrong clock"),
        (outlier, "outliers"),
        (jump, "jumps"),
        (flip, "flips"),
        (frozen, "frozen"),
        (disagree, "against another source"),
    ];
    let counted: Vec<_> = reasons
        .iter()
        .filter(|(count, _)| *count > 0)
        .map(|(count, reason)| format!("{count} {reason}"))
        .collect();
    if counted.is_empty() { String::new() } else { format!(" ({})", counted.join(", ")) }
}

fn of_timing(timing: &Timing, with_arrivals: bool) -> String {
    let falls = &timing.waterfall;
    let mut out = format!(
        "{} images in {:.0} s, {} answered by a setpoint\n\n{:<9} {:>7} {:>7} {:>7} {:>7}  ms\n",
        falls.images, timing.seconds, falls.answered, "stage", "p50", "p90", "p99", "max"
    );
    let width_ms = Stage::ALL.iter().map(|&stage| falls.stages[stage].p50).sum::<f32>();
    let per_ms = BAR / width_ms.max(falls.total.p99).max(0.1);
    let mut start_ms = 0.0;
    for stage in Stage::ALL {
        let times = &falls.stages[stage];
        out += &row(stage.name(), times, &bar(start_ms, times, per_ms));
        start_ms += times.p50;
    }
    out += &row("age", &falls.age, &bar(0.0, &falls.age, per_ms));
    out += &row("total", &falls.total, &bar(0.0, &falls.total, per_ms));
    out += &of_intervals(&timing.intervals);
    match &timing.clock {
        Some(clock) => out += &of_clock(clock, falls.clamped, falls.out_of_bound),
        None => out += "clock       not synchronized with the server yet\n",
    }
    if with_arrivals {
        out += "\nimages      that reached the runtime\n";
        for (index, arrivals) in timing.cameras.iter().enumerate() {
            out += &of_arrivals(index, arrivals);
        }
    }
    out
}

fn row(name: &str, times: &StageTimes, bar: &str) -> String {
    let StageTimes { p50, p90, p99, max } = times;
    format!("{name:<9} {p50:7.2} {p90:7.2} {p99:7.2} {max:7.2}  {bar}\n")
}

/// Returns the bar of a stage, which starts where the earlier stages end (median): dark up to the
/// median, light up to the 99th percentile.
fn bar(start_ms: f32, times: &StageTimes, per_ms: f32) -> String {
    let column = |ms: f32| ((start_ms + ms) * per_ms).round().clamp(0.0, BAR) as usize;
    let (start, median, most) = (column(0.0), column(times.p50), column(times.p99));
    let (full, light) = (median.saturating_sub(start), most.saturating_sub(median));
    // A short stage still gets a mark.
    let mark = if full + light == 0 { "▏" } else { "" };
    format!("{}{}{}{mark}", " ".repeat(start), "█".repeat(full), "░".repeat(light))
}

fn of_intervals(intervals: &Intervals) -> String {
    let StageTimes { p50, p90, p99, max } = intervals.times;
    let mut out = format!(
        "\njitter      between images at the plugin: p50 {p50:.1}, p90 {p90:.1}, p99 {p99:.1}, max \
         {max:.1} ms\n"
    );
    let bins = &intervals.bins;
    let most = bins.iter().copied().max().unwrap_or(0).max(1);
    let first = bins.iter().position(|&count| count > 0).unwrap_or(bins.len());
    let last = bins.iter().rposition(|&count| count > 0).map_or(first, |last| last + 1);
    for (index, &count) in bins.iter().enumerate().take(last).skip(first) {
        let from = index.checked_sub(1).map_or(0.0, |below| INTERVAL_EDGES_MS[below]);
        let range = match INTERVAL_EDGES_MS.get(index) {
            Some(to) => format!("{from:.0} to {to:.0}"),
            None => format!("over {from:.0}"),
        };
        let length = (f64::from(count) / f64::from(most) * 30.0).ceil() as usize;
        let _ = writeln!(out, "{range:>12} ms {count:>7} {}", "█".repeat(length));
    }
    out
}

fn of_clock(clock: &ClockState, clamped: u64, out_of_bound: u64) -> String {
    let mut out = format!(
        "\nclock       server is {:.3} ms ahead, error at most {:.3} ms; drift {:.1} ppm, error at \
         most {:.1}\n",
        clock.offset_ns as f64 * 1e-6,
        clock.error_bound_ms,
        clock.drift_ppm,
        clock.drift_bound_ppm
    );
    if clock.steps + u32::try_from(clamped + out_of_bound).unwrap_or(u32::MAX) > 0 {
        let _ = writeln!(
            out,
            "            was set {} times; {clamped} images arrived before they were sent by less \
             than the error bound, {out_of_bound} by more",
            clock.steps
        );
    }
    out
}

fn of_account(camera: &str, account: &Delivery) -> String {
    let Delivery { rendered, delivered, under_way, skipped } = account;
    let mut out = format!(
        "  {camera:<9} {rendered} rendered, {delivered} delivered, {} skipped, {under_way} under way\n",
        skipped.sum()
    );
    for ((name, count), (_, why)) in skipped.each().into_iter().zip(REASONS) {
        if count > 0 {
            let _ = writeln!(out, "  {count:>9} {name:<10} {why}");
        }
    }
    out
}

fn of_arrivals(index: usize, arrivals: &Arrivals) -> String {
    let Arrivals { arrived, delivered, stale, broken, superseded, unasked, overrun } = *arrivals;
    let mut out = format!("  camera {index}  {arrived} arrived, {delivered} delivered\n");
    let counts = [stale, broken, superseded, unasked, overrun];
    for (count, (name, why)) in counts.into_iter().zip(&REASONS[3..]) {
        if count > 0 {
            let _ = writeln!(out, "  {count:>9} {name:<10} {why}");
        }
    }
    out
}

fn of_connection(connection: &Connection) -> String {
    format!(
        "\nconnection  round trip {:.2} ms, {:.1} Mbit/s since {:.0} s, {} of {} packets lost, window \
         {} KB, packets of {} bytes\n",
        connection.rtt_ms,
        connection.mbit_s,
        connection.seconds,
        connection.packets_lost,
        connection.packets_sent,
        connection.window / 1000,
        connection.mtu
    )
}

/// Reasons for skipped images, in the order of the stages.
const REASONS: [(&str, &str); 8] = [
    ("no_room", "a newer one was rendered before encoder and transport had room"),
    ("failed", "could not be encoded"),
    ("late", "dropped on the way: past its deadline, or connection lost"),
    ("stale", "a newer one had arrived already"),
    ("broken", "could not be decoded"),
    ("superseded", "a newer one arrived before the decoder was free"),
    ("unasked", "a newer one was decoded before the idle plugin requested one"),
    ("overrun", "a newer one was decoded while the plugin was busy with an earlier one"),
];
/// Columns of the longest bar.
const BAR: f32 = 40.0;

#[cfg(test)]
mod tests {
    use super::*;
    use vizflyt_protocol::messages::{Stages, Waterfall};
    use vizflyt_server::stream::delivery::Skipped;

    fn times(p50: f32) -> StageTimes {
        StageTimes { p50, p90: p50 * 1.5, p99: p50 * 2.0, max: p50 * 3.0 }
    }

    fn timing() -> Timing {
        let mut bins = [0; 20];
        (bins[7], bins[8]) = (30, 270);
        Timing {
            seconds: 5.0,
            waterfall: Waterfall {
                images: 300,
                answered: 299,
                stages: Stages::from_fn(|stage| {
                    times(if stage == Stage::Render { 8.0 } else { 1.0 })
                }),
                age: times(14.0),
                total: times(16.0),
                clamped: 2,
                out_of_bound: 0,
            },
            intervals: Intervals { times: times(16.7), bins },
            clock: Some(ClockState { offset_ns: -1_500_000, ..ClockState::default() }),
            cameras: [Arrivals { arrived: 9, delivered: 8, overrun: 1, ..Arrivals::default() }]
                .into_iter()
                .collect(),
        }
    }

    #[test]
    fn prints_a_line_for_every_stage() {
        let text = of_timing(&timing(), true);
        let lines: Vec<_> = text.lines().collect();
        let mut last = 0;
        for stage in Stage::ALL {
            let line = lines.iter().find(|line| line.starts_with(stage.name())).unwrap();
            let start = line.chars().position(|c| "█░▏".contains(c)).unwrap();
            assert!(start >= last, "{text}");
            last = start;
        }
        assert!(text.contains("16 to 18 ms     270"), "{text}");
        assert!(text.contains("is -1.500 ms ahead"), "{text}");
        assert!(text.contains("2 images arrived before"), "{text}");
        assert!(text.contains("camera 0  9 arrived, 8 delivered"), "{text}");
        assert!(text.contains("overrun"), "{text}");
        let empty = of_timing(&Timing::default(), true);
        assert!(empty.contains("not synchronized"), "{empty}");
    }

    #[test]
    fn names_the_reasons_for_skipped_images() {
        let skipped = Skipped { no_room: 3, overrun: 2, ..Skipped::default() };
        let text =
            of_account("front", &Delivery { rendered: 9, delivered: 4, under_way: 0, skipped });
        assert!(text.contains("9 rendered, 4 delivered, 5 skipped, 0 under way"), "{text}");
        assert!(text.contains("3 no_room") && text.contains("2 overrun"), "{text}");
        assert!(!text.contains("stale"), "{text}");
        let names = Skipped::default().each().map(|(name, _)| name);
        assert_eq!(names, REASONS.map(|(name, _)| name));
    }

    #[test]
    fn reports_missing_parts() {
        let json = r#"{"vehicle": "wasp", "runtime": null, "server": SERVER, "timing": null,
                       "images": [], "connection": null, "pose": POSE}"#;
        let server = serde_json::to_string(&vizflyt_server::web::ServerStages::default());
        let pose = serde_json::to_string(&vizflyt_arena::pose::PoseQuality::default());
        let json = json.replace("SERVER", &server.unwrap()).replace("POSE", &pose.unwrap());
        let mut answer = parse(&json).unwrap();
        let error = of_vehicle(&answer).unwrap_err();
        assert!(error.to_string().contains("no runtime flies 'wasp'"), "{error}");
        answer.runtime = Some("runtime 0.1 at 127.0.0.1:9".to_owned());
        assert!(of_vehicle(&answer).unwrap().contains("no report of the runtime yet"));
    }
}
