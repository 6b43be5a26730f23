//! `vizflyt evaluate`: errors of an estimated trajectory, computed as by `evo`.

mod errors;
mod page;
mod pairs;
pub mod trajectory;

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use serde::Serialize;
use vizflyt_process::print_line;

pub use self::errors::{Alignment, Delta};
use self::errors::{Error, Statistics};
use self::pairs::Pair;
pub use self::pairs::{Association, associate, interpolated};
pub use self::trajectory::{Stamped, read};

/// Measure absolute and relative errors of a trajectory
#[derive(Args, Debug)]
#[command(after_help = "Examples:
  vizflyt evaluate truth.tum odometry.tum --align se3
  vizflyt evaluate flight.mcap odometry.tum --align yaw --delta 1s --html drift.html
  vizflyt evaluate flight.mcap#/pose flight.mcap#/odometry --align yaw --json
  vizflyt evaluate their-capture my-capture --align sim3

A trajectory is TUM's text (stamp tx ty tz qx qy qz qw), EuRoC's CSV, or a flight's log with a topic of poses
(default: /pose). Or both are folders of photos with poses (COLMAP, transforms.json): photos with the same name are
compared, one second apart. The numbers match those of evo_ape and evo_rpe: docs/guides/logs.md.")]
pub struct EvaluateArgs {
    /// True trajectory
    #[arg(value_name = "TRUTH")]
    truth: String,
    /// Estimated trajectory
    #[arg(value_name = "ESTIMATE")]
    estimate: String,
    /// Unknown part of the estimate's frame, found by least squares
    #[arg(long, value_enum, default_value = "none")]
    align: Alignment,
    /// Interval of relative errors: path length of the estimate, or time
    #[arg(long, value_name = "1m|1s", default_value = "1m", value_parser = delta)]
    delta: Delta,
    /// Association of poses at the times of the trajectory with fewer poses
    #[arg(long, value_enum, default_value = "interpolate")]
    associate: Association,
    /// Maximum time difference of associated poses [s]
    #[arg(long, value_name = "SECONDS", default_value_t = 0.01)]
    max_diff: f64,
    /// Print the errors as JSON
    #[arg(long)]
    json: bool,
    /// HTML page with both trajectories and the drift
    #[arg(long, value_name = "FILE")]
    html: Option<PathBuf>,
}

/// Runs `vizflyt evaluate`.
pub fn run(args: &EvaluateArgs) -> Result<ExitCode> {
    ensure!(
        args.max_diff >= 0.0 && args.max_diff.is_finite(),
        "--max-diff must be a time of 0 s or more"
    );
    let are_photos = [&args.truth, &args.estimate].map(|source| Path::new(source).is_dir());
    let (truth, estimate) = match are_photos {
        [true, true] => trajectory::of_photos(&args.truth, &args.estimate)?,
        [false, false] => (trajectory::read(&args.truth)?, trajectory::read(&args.estimate)?),
        _ => bail!(
            "one of {} and {} is a folder of photos, the other is not",
            args.truth,
            args.estimate
        ),
    };
    let pairs = associate(&truth, &estimate, args.associate, args.max_diff);
    ensure!(
        !pairs.is_empty(),
        "no two poses are within {} s of each other: {} is from {:.3} to {:.3} s, {} from {:.3} to {:.3} s; do they \
         use the same clock? --max-diff allows more",
        args.max_diff,
        args.truth,
        truth[0].at_s,
        truth[truth.len() - 1].at_s,
        args.estimate,
        estimate[0].at_s,
        estimate[estimate.len() - 1].at_s,
    );
    let evaluation = Evaluation::of(&pairs, args.align, args.delta)?;
    if let Some(path) = &args.html {
        let page = page::html(&args.truth, &args.estimate, &evaluation);
        std::fs::write(path, page).with_context(|| format!("cannot write {}", path.display()))?;
    }
    if args.json {
        print_line(serde_json::to_string_pretty(&evaluation.figures)?);
    } else {
        print_line(evaluation.text());
    }
    Ok(ExitCode::SUCCESS)
}

/// Parses `1m`, `0.5s`.
fn delta(text: &str) -> Result<Delta, String> {
    let wrong = || format!("'{text}' is neither metres nor seconds: 1m, 0.5s");
    let (number, of): (&str, fn(f64) -> Delta) =
        match (text.strip_suffix('m'), text.strip_suffix('s')) {
            (Some(number), _) => (number, Delta::Metres),
            (_, Some(number)) => (number, Delta::Seconds),
            _ => return Err(wrong()),
        };
    number
        .parse()
        .ok()
        .filter(|value: &f64| *value > 0.0 && value.is_finite())
        .map(of)
        .ok_or_else(wrong)
}

/// Comparison of an estimate with the truth.
pub struct Evaluation {
    /// Pairs with the estimate in the truth's frame.
    pairs: Vec<Pair>,
    absolute: Vec<Error>,
    /// Summary for printing.
    pub figures: Figures,
}

/// Output of `--json`. Values that cannot be determined from these trajectories are null.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Figures {
    align: String,
    delta: String,
    /// Number of compared pairs of poses.
    pub pairs: usize,
    /// Time from the first to the last pair. [s]
    seconds: f64,
    /// Length of the true path. [m]
    path_m: f64,
    /// Factor by which the estimate was multiplied.
    scale: f64,
    /// Absolute position error, root mean square. [m]
    pub ate_rmse_m: f64,
    ate_mean_m: f64,
    ate_median_m: f64,
    /// Maximum absolute position error. [m]
    pub ate_max_m: f64,
    ate_rot_rmse_deg: f64,
    ate_rot_max_deg: f64,
    /// Number of steps of `delta` for the relative errors.
    rpe_pairs: usize,
    /// Relative position error over `delta`, root mean square. [m]
    pub rpe_trans_rmse_m: Option<f64>,
    rpe_trans_max_m: Option<f64>,
    /// Relative rotation error over `delta`, root mean square. [deg]
    pub rpe_rot_rmse_deg: Option<f64>,
    rpe_rot_max_deg: Option<f64>,
    /// Relative errors for increasing distances.
    by_distance: Vec<ByDistance>,
}

/// Relative errors over one distance.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ByDistance {
    distance_m: f64,
    steps: usize,
    trans_rmse_m: f64,
    /// Position error relative to the distance. [%]
    trans_percent: f64,
    rot_rmse_deg: f64,
}

/// Distances for which the drift is shown. [m]
const DISTANCES_M: [f64; 7] = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];

impl Evaluation {
    /// Computes the errors of at least one pair.
    ///
    /// # Errors
    /// There are no pairs, or they cannot be aligned.
    pub fn of(pairs: &[Pair], alignment: Alignment, delta: Delta) -> Result<Self> {
        ensure!(!pairs.is_empty(), "no pose to compare");
        let place = errors::align(pairs, alignment)?;
        let pairs = errors::aligned(pairs, &place);
        let absolute = errors::absolute(&pairs);
        let places = |errors: &[Error]| Statistics::of(errors.iter().map(|error| error.place_m));
        let turns = |errors: &[Error]| {
            Statistics::of(errors.iter().map(|error| error.turn_rad.to_degrees()))
        };
        let (ate, ate_rot) =
            places(&absolute).zip(turns(&absolute)).context("no pose to compare")?;
        let relative = errors::relative(&pairs, &errors::steps(&pairs, delta));
        let (rpe, rpe_rot) = (places(&relative), turns(&relative));
        let by_distance = DISTANCES_M.iter().filter_map(|&distance_m| {
            let errors =
                errors::relative(&pairs, &errors::steps(&pairs, Delta::Metres(distance_m)));
            let (place, turn) = places(&errors).zip(turns(&errors))?;
            let trans_percent = 100.0 * place.rmse / distance_m;
            Some(ByDistance {
                distance_m,
                steps: errors.len(),
                trans_rmse_m: place.rmse,
                trans_percent,
                rot_rmse_deg: turn.rmse,
            })
        });
        let ways =
            pairs.windows(2).map(|two| two[0].truth.position_m.distance(two[1].truth.position_m));
        let figures = Figures {
            align: format!("{alignment:?}").to_lowercase(),
            delta: match delta {
                Delta::Metres(metres) => format!("{metres} m"),
                Delta::Seconds(seconds) => format!("{seconds} s"),
            },
            pairs: pairs.len(),
            seconds: pairs[pairs.len() - 1].estimate.at_s - pairs[0].estimate.at_s,
            path_m: ways.sum(),
            scale: place.scale,
            ate_rmse_m: ate.rmse,
            ate_mean_m: ate.mean,
            ate_median_m: ate.median,
            ate_max_m: ate.max,
            ate_rot_rmse_deg: ate_rot.rmse,
            ate_rot_max_deg: ate_rot.max,
            rpe_pairs: relative.len(),
            rpe_trans_rmse_m: rpe.map(|statistics| statistics.rmse),
            rpe_trans_max_m: rpe.map(|statistics| statistics.max),
            rpe_rot_rmse_deg: rpe_rot.map(|statistics| statistics.rmse),
            rpe_rot_max_deg: rpe_rot.map(|statistics| statistics.max),
            by_distance: by_distance.collect(),
        };
        Ok(Self { pairs, absolute, figures })
    }

    fn text(&self) -> String {
        let figures = &self.figures;
        let mut lines = vec![
            format!(
                "poses       {} of both, {:.1} s, {:.2} m",
                figures.pairs, figures.seconds, figures.path_m
            ),
            format!("alignment   {}, scale {:.6}", figures.align, figures.scale),
            format!(
                "absolute    rmse {:.4} m, mean {:.4}, median {:.4}, max {:.4}; attitude rmse {:.3} deg, max {:.3}",
                figures.ate_rmse_m,
                figures.ate_mean_m,
                figures.ate_median_m,
                figures.ate_max_m,
                figures.ate_rot_rmse_deg,
                figures.ate_rot_max_deg
            ),
        ];
        lines.push(match (figures.rpe_trans_rmse_m, figures.rpe_rot_rmse_deg) {
            (Some(metres), Some(degrees)) => format!(
                "relative    rmse {metres:.4} m, {degrees:.3} deg over each of {} steps of {}",
                figures.rpe_pairs, figures.delta
            ),
            _ => format!(
                "relative    none: the trajectory is shorter than {}; give a smaller --delta",
                figures.delta
            ),
        });
        if !figures.by_distance.is_empty() {
            lines.push("drift        over m   rmse m      %    deg   steps".to_owned());
        }
        lines.extend(figures.by_distance.iter().map(|row| {
            format!(
                "            {:>7} {:8.4} {:6.2} {:6.3} {:7}",
                row.distance_m, row.trans_rmse_m, row.trans_percent, row.rot_rmse_deg, row.steps
            )
        }));
        lines.join("\n")
    }
}
