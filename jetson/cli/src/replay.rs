//! `vizflyt replay`: a flight's log to a plugin, and where its answers differ from the flight's.

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

/// Feeds a flight's recorded images to the plugin again, or to another one, and reports where the
/// answers differ.
#[derive(Args, Clone, Debug)]
#[command(after_help = "Examples:
  vizflyt replay flights/2026-11-21T04-09-21.123Z.mcap
  vizflyt replay flight.mcap --plugin ./my_plugin.py    how another plugin had answered
  vizflyt replay flight.mcap --answers one.jsonl        all answers; cmp compares two runs
  vizflyt replay flight.mcap --poses-to 127.0.0.1:51002 only its poses, to `vizflyt serve ARENA --pose json`

Nothing is flown. Status 0 if the plugin came to the end of the log, 1 if it failed.")]
pub(crate) struct ReplayArgs {
    /// A flight's log
    #[arg(value_name = "FLIGHT.mcap")]
    log: PathBuf,
    /// The plugin, as for `vizflyt fly` [default: the one that flew]
    #[arg(long, value_name = "PLUGIN")]
    plugin: Option<OsString>,
    /// Arguments for the plugin, after `--`
    #[arg(last = true, value_name = "ARGUMENT", requires = "plugin")]
    plugin_arguments: Vec<OsString>,
    /// The map that the flight's plugin was handed (map.json), if it was
    #[arg(long, value_name = "FILE")]
    map: Option<PathBuf>,
    /// Sends the flight's poses there at its pace, as packets that `vizflyt serve --pose json` reads, and
    /// nothing else
    #[arg(long, value_name = "HOST:PORT", conflicts_with_all = ["plugin", "map", "all", "answers", "report"])]
    poses_to: Option<SocketAddr>,
    /// The name of the vehicle in those packets
    #[arg(long, value_name = "NAME", default_value = "vizflyt", requires = "poses_to")]
    object: String,
    /// At the flight's pace, instead of as fast as the plugin answers
    #[arg(long)]
    realtime: bool,
    /// Feeds the images, too, that the plugin skipped in flight because it was busy
    #[arg(long)]
    all: bool,
    /// An answer that takes longer than this ends the replay
    #[arg(long, value_name = "SECONDS", default_value_t = 30.0)]
    within: f64,
    /// Writes every answer there, one JSON object per line
    /// [default: beside the log, ending in .answers.jsonl]
    #[arg(long, value_name = "FILE")]
    answers: Option<PathBuf>,
    /// Writes what was found there as JSON
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
}

/// Replays a log and prints what came of it.
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
    // Confined as in flight: what it could not do there it cannot do here.
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
            .with_context(|| format!("--within {}: that is no time", args.within))?,
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
            .with_context(|| format!("report {} cannot be written", path.display()))?;
    }
    for sentence in sentences(&report) {
        print_line(sentence);
    }
    print_line(format!("answers: {}", options.answers.display()));
    Ok(if report.plugin_failed.is_some() { ExitCode::FAILURE } else { ExitCode::SUCCESS })
}

/// Returns the plugin that flew, if a log may choose it: a built-in, or something in this folder. A
/// log of somebody else must not choose what this computer runs.
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
            "{plugin} flew, which is not in this folder; name a plugin with --plugin, as a log does \
             not choose what runs here"
        );
    }
    Ok((plugin.into(), arguments.iter().map(OsString::from).collect()))
}

/// Returns what was found, for people.
fn sentences(report: &ReplayReport) -> Vec<String> {
    let ReplayReport { images_logged, images_fed, images_missing, compared, differ, .. } = report;
    let ReplayReport { images_left_out, .. } = report;
    let mut found = vec![format!(
        "{images_fed} of {images_logged} images were answered in {:.1} s",
        report.seconds
    )];
    if *images_left_out > 0 {
        found.push(format!(
            "a reduced log: it holds {} of {images_logged} images, each as it came. A plugin that \
             answers every image by itself answers as in flight, one with a memory may not; fly \
             with --log full for a replay of all",
            images_logged.saturating_sub(*images_left_out)
        ));
    }
    if *images_missing > 0 {
        found.push(format!(
            "{images_missing} images that the plugin had in flight are not in the log; from there \
             on a plugin with a memory may differ"
        ));
    }
    if *compared == 0 {
        found.push("the flight has no answer to compare with".into());
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
    fn a_log_does_not_choose_what_runs() {
        let plugin = |name: &str| FlownPlugin { plugin: name.into(), arguments: vec!["x".into()] };
        assert_eq!(flown(Some(&plugin("avoid"))).unwrap().0, "avoid");
        for name in ["/bin/sh", "reboot", "../../elsewhere"] {
            let error = flown(Some(&plugin(name))).unwrap_err().to_string();
            assert!(error.contains("--plugin"), "{error}");
        }
        // A test runs in its crate's folder.
        assert_eq!(flown(Some(&plugin("./src/main.rs"))).unwrap().1, ["x"]);
        assert!(flown(None).is_err());
    }

    #[test]
    fn findings_are_printed() {
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
