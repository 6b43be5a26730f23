//! `vizflyt replay`: feeds a flight's log to a plugin, and compares its answers with those of the
//! flight.

mod poses;

use std::ffi::OsString;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use clap::Args;
use serde_json::json;
use vizflyt_grading::plugin::Plugin;
use vizflyt_grading::plugin::built_in::BuiltIn;
use vizflyt_process::{print_error, print_line};
use vizflyt_runtime::log::read::{LogReader, RecordedFlight, RecordedPoses};
use vizflyt_runtime::replay::{
    Differs, FlownPlugin, ReplayOptions, ReplayPlan, ReplayReport, replay,
};
use vizflyt_runtime::supervisor::{PluginLimits, Stream};

/// Feed recorded images to a plugin, and compare its answers
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt replay flights/2026-11-21T04-09-21.123Z.mcap
  vizflyt replay flight.mcap --plugin ./my_plugin.py    answers of another plugin
  vizflyt replay flight.mcap --answers one.jsonl        write all answers; compare two runs with cmp
  vizflyt replay flight.mcap --poses-to 127.0.0.1:51002 send only the poses, to `vizflyt serve ARENA --pose json`

Nothing flies. Status 0 if the plugin reached the end of the log, 1 if it failed.")]
pub(crate) struct ReplayArgs {
    /// Log of a flight
    #[arg(value_name = "FLIGHT.mcap")]
    log: PathBuf,
    /// Plugin, as for `vizflyt fly` [default: the plugin of the flight]
    #[arg(long, help_heading = "Plugin", value_name = "PLUGIN")]
    plugin: Option<OsString>,
    /// Arguments for the plugin, after `--`
    #[arg(last = true, value_name = "ARGUMENT", requires = "plugin")]
    plugin_arguments: Vec<OsString>,
    /// Map file of the flight (map.json), if its plugin received one
    #[arg(long, help_heading = "Plugin", value_name = "FILE")]
    map: Option<PathBuf>,
    /// Also feed the images that the plugin skipped in flight because it was busy
    #[arg(long, help_heading = "Images")]
    all: bool,
    /// Replay at the pace of the flight, instead of as fast as the plugin answers
    #[arg(long, help_heading = "Images")]
    realtime: bool,
    /// Timeout of an answer; then the replay ends
    #[arg(long, help_heading = "Images", value_name = "SECONDS", default_value_t = 30.0)]
    within: f64,
    /// Send only the flight's poses to this address, at the pace of the flight
    ///
    /// The packets have the format of `vizflyt serve --pose json`.
    #[arg(long, help_heading = "Localization", value_name = "HOST:PORT", conflicts_with_all = ["plugin", "map", "all", "answers", "report"])]
    poses_to: Option<SocketAddr>,
    /// Name of the vehicle in those packets
    #[arg(
        long,
        help_heading = "Localization",
        value_name = "NAME",
        default_value = "vizflyt",
        requires = "poses_to"
    )]
    object: String,
    /// File for all answers, one JSON object per line
    ///
    /// [default: next to the log, ending in .answers.jsonl]
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    answers: Option<PathBuf>,
    /// File for the results, as JSON
    #[arg(long, help_heading = "Output", value_name = "FILE")]
    report: Option<PathBuf>,
}

/// Replays a log and prints the results.
pub(crate) fn run(args: &ReplayArgs) -> Result<ExitCode> {
    let cannot = || format!("cannot replay {}", args.log.display());
    let reader = LogReader::open(&args.log).with_context(cannot)?;
    if let Some(to) = args.poses_to {
        let sent =
            poses::send(RecordedPoses::new(reader), to, &args.object).with_context(cannot)?;
        print_line(format!("{sent} poses sent to {to}"));
        return Ok(ExitCode::SUCCESS);
    }
    let plan = ReplayPlan::read(RecordedFlight::new(reader, false)).with_context(cannot)?;
    let (plugin, arguments) = match &args.plugin {
        Some(plugin) => (plugin.clone(), args.plugin_arguments.clone()),
        None => flown(plan.flown.as_ref())?,
    };
    // Same sandbox as in flight, so that the plugin has the same rights.
    let mut limits = PluginLimits::default();
    let mut command = Plugin::find(&plugin)?.command(&limits)?;
    command.extend(arguments);
    if let Some(path) = &args.map {
        limits.hand_map_file(path)?;
    }
    let options = ReplayOptions {
        command,
        limits,
        is_realtime: args.realtime,
        all: args.all,
        answer_within: Duration::try_from_secs_f64(args.within)
            .with_context(|| format!("--within {}: not a valid duration", args.within))?,
        answers: args.answers.clone().unwrap_or_else(|| args.log.with_extension("answers.jsonl")),
    };
    if plan.is_cut {
        print_line("the log ends early: its runtime was killed, or its disk was full");
    }
    let line = &mut |stream: Stream, text: &str| match stream {
        Stream::Stdout => print_line(format!("plugin: {text}")),
        Stream::Stderr => print_error(format_args!("plugin: {text}")),
    };
    let report = replay(&args.log, plan, &options, line).with_context(cannot)?;
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&json!({
            "log": args.log, "plugin": plugin.to_string_lossy(), "answers": options.answers,
            "found": report,
        }))?;
        std::fs::write(path, text + "\n")
            .with_context(|| format!("cannot write the report {}", path.display()))?;
    }
    for sentence in sentences(&report) {
        print_line(sentence);
    }
    print_line(format!("answers: {}", options.answers.display()));
    Ok(if report.plugin_failed.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Returns the plugin of the flight, if the log may select it: a built-in, or a file in the current
/// folder. A log from another computer must not select what runs here.
fn flown(flown: Option<&FlownPlugin>) -> Result<(OsString, Vec<OsString>)> {
    let Some(FlownPlugin { plugin, arguments }) = flown else {
        bail!("the log does not name the plugin that flew; give one with --plugin");
    };
    let here = std::env::current_dir().and_then(|folder| folder.canonicalize());
    let is_here = |path: &Path| {
        path.canonicalize().is_ok_and(|path| here.as_ref().is_ok_and(|here| path.starts_with(here)))
    };
    if BuiltIn::find(plugin).is_none() && !is_here(Path::new(plugin)) {
        bail!(
            "{plugin} flew, which is not in this folder; give a plugin with --plugin: a log may not \
             select other programs of this computer"
        );
    }
    Ok((plugin.into(), arguments.iter().map(OsString::from).collect()))
}

/// Returns the results as sentences.
fn sentences(report: &ReplayReport) -> Vec<String> {
    let ReplayReport { images_logged, images_fed, images_missing, compared, differ, .. } = report;
    let ReplayReport { images_left_out, .. } = report;
    let mut found = vec![format!(
        "{images_fed} of {images_logged} images were answered in {:.1} s",
        report.seconds
    )];
    if *images_left_out > 0 {
        found.push(format!(
            "a reduced log: it holds {} of {images_logged} images, each unchanged. A plugin \
             without state between images answers as in flight, one with state may not; for a replay \
             of all images, fly with --log full",
            images_logged.saturating_sub(*images_left_out)
        ));
    }
    if *images_missing > 0 {
        found.push(format!(
            "{images_missing} images that the plugin had in flight are not in the log; after them, \
             the answers of a plugin with state may differ"
        ));
    }
    if *compared == 0 {
        found.push("the log has no answers to compare with".into());
    } else if *differ == 0 {
        found.push(format!("all {compared} answers are those of the flight, bit by bit"));
    } else {
        found.push(format!("{differ} of {compared} answers differ from the flight's"));
        found.extend(report.first.as_ref().map(|first| format!("first:   {}", differs(first))));
        found.extend(
            report.largest.as_ref().map(|largest| format!("largest: {}", differs(largest))),
        );
    }
    found.extend(report.plugin_failed.as_ref().map(|why| format!("the replay ended: {why}")));
    found
}

fn differs(differs: &Differs) -> String {
    let Differs { image, at_s, difference, recorded, replayed } = differs;
    if difference.amount.is_infinite() {
        let name = |setpoint: &Option<_>| match setpoint {
            Some(setpoint) => format!("{setpoint:?}"),
            None => "no setpoint".to_owned(),
        };
        let (then, now) = (name(recorded), name(replayed));
        return format!("image {image}, {at_s:.2} s: {then} in flight, {now} now");
    }
    format!("image {image}, {at_s:.2} s: {} by {:.3e}", difference.field, difference.amount)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_does_not_select_other_programs() {
        let plugin = |name: &str| FlownPlugin { plugin: name.into(), arguments: vec!["x".into()] };
        assert_eq!(flown(Some(&plugin("avoid"))).unwrap().0, "avoid");
        for name in ["/bin/sh", "reboot", "../../elsewhere"] {
            let error = flown(Some(&plugin(name))).unwrap_err().to_string();
            assert!(error.contains("--plugin"), "{error}");
        }
        // Tests run in the folder of their crate.
        assert_eq!(flown(Some(&plugin("./src/main.rs"))).unwrap().1, ["x"]);
        assert!(flown(None).is_err());
    }

    #[test]
    fn prints_the_results() {
        let mut report = ReplayReport { compared: 3, ..ReplayReport::default() };
        assert!(sentences(&report).iter().any(|text| text.contains("all 3 answers")));
        report.differ = 1;
        report.first = Some(Differs {
            image: 7,
            at_s: 1.5,
            difference: vizflyt_runtime::replay::Difference {
                field: "velocity.v_mps.0".into(),
                amount: 0.25,
            },
            recorded: None,
            replayed: None,
        });
        let text = sentences(&report).join("\n");
        assert!(!text.contains("reduced"), "{text}");
        (report.images_logged, report.images_left_out) = (40, 30);
        let reduced = sentences(&report).join("\n");
        assert!(reduced.contains("a reduced log: it holds 10 of 40 images"), "{reduced}");
        assert!(text.contains("image 7, 1.50 s: velocity.v_mps.0 by 2.500e-1"), "{text}");
    }
}
