//! Measures the delay of a localization source while the vehicle is moved by hand: compares the
//! attitudes of its poses with the readings of the gyroscope. Sans-IO.
//!
//! ```text
//! poses -----> angle turned within 0.25 s --------\
//! gyroscope -> the same, so much earlier ----------+-> correlation -> its peak: the delay
//! ```
//! The comparison uses angles, not axes: of all settings only `euler` changes the angle between two
//! poses. Readings may have another rate than poses, also an uneven one: they are integrated over
//! the times of the poses.

use std::collections::VecDeque;

use glam::{DQuat, DVec3};

/// A measured delay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Delay {
    /// Delay of the poses relative to the gyroscope. [ms]
    pub(super) ms: f64,
    /// Uncertainty, two standard deviations. [ms]
    pub(super) uncertain_ms: f64,
}

/// Why the delay could not be measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NoDelay {
    /// Too few readings or poses.
    Silent,
    /// Motion too slow or too small, or poses too noisy.
    Gentle,
    /// Poses and gyroscope do not show the same motion.
    Unlike,
}

/// Collects attitudes and gyroscope readings.
#[derive(Debug, Default)]
pub(super) struct DelayMeter {
    gyro: VecDeque<(f64, DVec3)>,
    poses: VecDeque<(f64, DQuat)>,
}

impl DelayMeter {
    /// Adds a reading of the gyroscope; stamps must increase. [s], [rad/s]
    pub(super) fn add_gyro(&mut self, at_s: f64, gyro_radps: DVec3) {
        add(&mut self.gyro, at_s, gyro_radps);
    }

    /// Adds the attitude of a pose; stamps must increase. [s]
    pub(super) fn add_pose(&mut self, at_s: f64, rotation: DQuat) {
        add(&mut self.poses, at_s, rotation);
    }

    /// Returns the delay.
    ///
    /// # Errors
    /// Why the delay could not be measured.
    pub(super) fn delay(&self) -> Result<Delay, NoDelay> {
        let turned = Turned::new(&self.gyro).ok_or(NoDelay::Silent)?;
        let windows = self.windows();
        if windows.len() < MIN_WINDOWS {
            return Err(NoDelay::Silent);
        }
        if windows.iter().filter(|window| window.angle_rad > LIVELY_RADPS * WINDOW_S).count()
            < LIVELY
        {
            return Err(NoDelay::Gentle);
        }
        let steps = ((LATEST_S - EARLIEST_S) / STEP_S) as u32;
        let tried = (0..=steps).map(|step| EARLIEST_S + f64::from(step) * STEP_S);
        let fits = tried.filter_map(|delay_s| Fit::new(&turned, &windows, delay_s));
        let best =
            fits.max_by(|a, b| a.correlation.total_cmp(&b.correlation)).ok_or(NoDelay::Silent)?;
        // The best delay must be a peak inside the tried range, not at its edge.
        let is_inside = (EARLIEST_S + STEP_S..LATEST_S - STEP_S).contains(&best.delay_s);
        if best.correlation < ALIKE || !is_inside {
            return Err(NoDelay::Unlike);
        }
        let mut fit = best;
        for step_s in [STEP_S, 0.3 * STEP_S] {
            let at = |delay_s| Fit::new(&turned, &windows, delay_s).ok_or(NoDelay::Silent);
            let (before, after) = (at(fit.delay_s - step_s)?, at(fit.delay_s + step_s)?);
            let bend = before.correlation - 2.0 * fit.correlation + after.correlation;
            let slope = after.correlation - before.correlation;
            let moved = if bend < 0.0 { (-0.5 * slope / bend).clamp(-1.0, 1.0) } else { 0.0 };
            fit = at(fit.delay_s + moved * step_s)?;
        }
        // Both measure the same angle: another ratio means another vehicle's gyroscope.
        if !(0.8..1.25).contains(&fit.ratio) {
            return Err(NoDelay::Unlike);
        }
        let uncertain_s = 2.0 * fit.sigma_s(&turned, &windows).ok_or(NoDelay::Silent)?;
        let delay = Delay { ms: fit.delay_s * 1e3, uncertain_ms: uncertain_s * 1e3 + LEAST_MS };
        if delay.uncertain_ms <= MAX_UNCERTAIN_MS { Ok(delay) } else { Err(NoDelay::Gentle) }
    }

    /// Returns the change of attitude between each pose and the one a window later.
    fn windows(&self) -> Vec<Window> {
        let mut windows = Vec::new();
        let mut end = 0;
        for (start, &(from_s, before)) in self.poses.iter().enumerate() {
            end = end.max(start);
            while self.poses.get(end).is_some_and(|&(at_s, _)| at_s - from_s < WINDOW_S) {
                end += 1;
            }
            let Some(&(to_s, after)) = self.poses.get(end) else { break };
            if to_s - from_s < 2.0 * WINDOW_S {
                windows.push(Window { from_s, to_s, angle_rad: before.angle_between(after) });
            }
        }
        // More windows of a fast source add no information.
        let every = windows.len().div_ceil(MAX_WINDOWS).max(1);
        windows.into_iter().step_by(every).collect()
    }
}

fn add<T>(queue: &mut VecDeque<(f64, T)>, at_s: f64, value: T) {
    if queue.back().is_some_and(|&(last_s, _)| at_s <= last_s) {
        return;
    }
    if queue.len() == MAX_SAMPLES {
        queue.pop_front();
    }
    queue.push_back((at_s, value));
}

/// A time interval, and the angle between the poses at its ends.
#[derive(Clone, Copy, Debug)]
struct Window {
    from_s: f64,
    to_s: f64,
    angle_rad: f64,
}

/// Attitude by integration of the gyroscope.
struct Turned {
    /// Time, rate from then to the next reading, attitude at that time, and index of the unbroken
    /// interval.
    knots: Vec<(f64, DVec3, DQuat, u32)>,
}

impl Turned {
    fn new(gyro: &VecDeque<(f64, DVec3)>) -> Option<Self> {
        let mut intervals: Vec<_> =
            gyro.iter().zip(gyro.iter().skip(1)).map(|(a, b)| b.0 - a.0).collect();
        intervals.sort_unstable_by(f64::total_cmp);
        let gap_s = MAX_GAP_S.max(2.5 * intervals.get(intervals.len() / 2)?);
        // A bias is constant: the median reading is the bias, not a motion.
        let middle = |axis: usize| {
            let mut values: Vec<_> = gyro.iter().map(|(_, rate)| rate[axis]).collect();
            values.sort_unstable_by(f64::total_cmp);
            values[values.len() / 2]
        };
        let bias = DVec3::new(middle(0), middle(1), middle(2));
        let bias = if bias.length() < MAX_BIAS_RADPS { bias } else { DVec3::ZERO };
        let mut knots: Vec<(f64, DVec3, DQuat, u32)> = Vec::with_capacity(gyro.len());
        for &(at_s, rate) in gyro {
            let rate = rate - bias;
            let (attitude, stretch) = match knots.last() {
                None => (DQuat::IDENTITY, 0),
                Some(&(last_s, _, attitude, stretch)) if at_s - last_s > gap_s => {
                    (attitude, stretch + 1)
                }
                Some(&(last_s, last, attitude, stretch)) => {
                    let turn = (last + rate) * (0.5 * (at_s - last_s));
                    (attitude * DQuat::from_scaled_axis(turn), stretch)
                }
            };
            knots.push((at_s, rate, attitude.normalize(), stretch));
        }
        Some(Self { knots })
    }

    /// Returns the attitude at a time, and the index of the unbroken interval.
    fn at(&self, at_s: f64) -> Option<(DQuat, u32)> {
        let after = self.knots.partition_point(|knot| knot.0 <= at_s);
        let (a, b) = (self.knots.get(after.checked_sub(1)?)?, self.knots.get(after)?);
        if a.3 != b.3 {
            return None;
        }
        // The rate is assumed to change linearly between two readings.
        let (since_s, whole_s) = (at_s - a.0, b.0 - a.0);
        let turn = (a.1 + (b.1 - a.1) * (0.5 * since_s / whole_s)) * since_s;
        Some((a.2 * DQuat::from_scaled_axis(turn), a.3))
    }

    /// Returns the angle turned within a window shifted earlier by `earlier_s`. [rad]
    fn angle_rad(&self, window: &Window, earlier_s: f64) -> Option<f64> {
        let (before, from) = self.at(window.from_s - earlier_s)?;
        let (after, to) = self.at(window.to_s - earlier_s)?;
        (from == to).then(|| before.angle_between(after))
    }
}

/// Agreement of poses and gyroscope under one delay.
#[derive(Clone, Copy, Debug)]
struct Fit {
    delay_s: f64,
    correlation: f64,
    /// Ratio of the angle by the poses to that by the gyroscope.
    ratio: f64,
    /// Residual angle between poses without a turn: noise. [rad]
    rest_rad: f64,
}

impl Fit {
    fn new(turned: &Turned, windows: &[Window], delay_s: f64) -> Option<Self> {
        let (mut n, mut x, mut y, mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0);
        for window in windows {
            let Some(gyro_rad) = turned.angle_rad(window, delay_s) else { continue };
            n += 1.0;
            x += gyro_rad;
            y += window.angle_rad;
            xx += gyro_rad * gyro_rad;
            xy += gyro_rad * window.angle_rad;
            yy += window.angle_rad * window.angle_rad;
        }
        // Both sensors must have data for at least half of the windows.
        if n < 0.5 * windows.len() as f64 {
            return None;
        }
        let (xx, xy, yy) = (xx - x * x / n, xy - x * y / n, yy - y * y / n);
        let ratio = xy / xx;
        let rest_rad = (y - ratio * x) / n;
        let correlation = xy / (xx * yy).sqrt();
        correlation.is_finite().then_some(Self { delay_s, correlation, ratio, rest_rad })
    }

    /// Returns the delay's standard deviation. Errors are correlated while windows overlap, and
    /// longer if a model is wrong: all errors within one second count as one. [s]
    fn sigma_s(&self, turned: &Turned, windows: &[Window]) -> Option<f64> {
        let (mut curvature, mut scores) = (0.0, Vec::<(i64, f64)>::new());
        for window in windows {
            let at = |delay_s| turned.angle_rad(window, delay_s);
            let Some(((before, now), after)) =
                at(self.delay_s - NEAR_S).zip(at(self.delay_s)).zip(at(self.delay_s + NEAR_S))
            else {
                continue;
            };
            let slope = self.ratio * (after - before) / (2.0 * NEAR_S);
            let off = window.angle_rad - self.ratio * now - self.rest_rad;
            curvature += slope * slope;
            let second = window.from_s.floor() as i64;
            match scores.last_mut() {
                Some((at, score)) if *at == second => *score += slope * off,
                _ => scores.push((second, slope * off)),
            }
        }
        let spread = scores.iter().map(|(_, score)| score * score).sum::<f64>().sqrt();
        (curvature > 0.0).then(|| spread / curvature)
    }
}

/// Length of a window: long enough for angles above the noise, shorter than a motion. [s]
const WINDOW_S: f64 = 0.25;
/// Range and step of the tried delays. [s]
const EARLIEST_S: f64 = -0.55;
const LATEST_S: f64 = 0.6;
const STEP_S: f64 = 0.01;
/// Step of numerical derivatives. [s]
const NEAR_S: f64 = 0.005;
/// Number of windows that must turn at least at `LIVELY_RADPS`: half a second at 20 Hz.
const LIVELY: usize = 10;
const LIVELY_RADPS: f64 = 0.4;
/// Minimum correlation for the same motion.
const ALIKE: f64 = 0.85;
/// Minimum uncertainty, due to the models of hands, filters and clocks. [ms]
const LEAST_MS: f64 = 1.0;
/// Maximum uncertainty of a result; above it, none is returned. [ms]
const MAX_UNCERTAIN_MS: f64 = 20.0;
/// Maximum bias; a larger median means that the vehicle turned most of the time. [rad/s]
const MAX_BIAS_RADPS: f64 = 0.1;
/// Maximum interval between readings; a longer one is a gap. [s]
const MAX_GAP_S: f64 = 0.08;
/// Minimum and maximum number of windows; maximum samples of each kind, three minutes at 200 Hz.
const MIN_WINDOWS: usize = 20;
const MAX_WINDOWS: usize = 3000;
const MAX_SAMPLES: usize = 36_000;

#[cfg(test)]
mod tests;
