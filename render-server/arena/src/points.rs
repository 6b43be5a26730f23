//! Points of a grade: a project's table of points, and the points of each row.
//!
//! ```text
//! [levels.ug.points] of a project + figures over all flights -> points, maximum, reason of each row
//! ```

use serde::{Deserialize, Serialize};

/// A project's table of points, for one level.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PointsTable {
    /// Maximum points for the mean score: all at 100, in proportion below.
    pub score: f64,
    /// Minimum mean score; below it, the other parts give no points. [0 to 100]
    #[serde(default)]
    pub least_score: f64,
    /// Bounds on the mean time to the finish, penalties included. [s]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub time_s: Option<Bounds>,
    /// Bounds on the minimum clearance of the flights that finish: a flight with a collision has already lost
    /// score. [m]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clearance_m: Option<Bounds>,
    /// Bounds on the maximum speed of a flight, the median of those that finish. [m/s]
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_mps: Option<Bounds>,
}

/// Figures for all points and for half of them; linear in between and beyond.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Bounds {
    /// Maximum points.
    pub points: f64,
    /// Figure from which all points are given.
    pub all: f64,
    /// Figure for half of the points; at twice the distance from `all`, there are none.
    pub half: f64,
}

/// Figures over all flights.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Figures {
    /// Mean score, 0 to 100.
    pub score: f64,
    /// Mean time to the finish; `None` if no flight finished. [s]
    pub time_s: Option<f64>,
    /// Minimum clearance of the flights that finished; `None` without finish or obstacles. [m]
    pub clearance_m: Option<f64>,
    /// Median of the maximum speeds of the flights that finished. [m/s]
    pub speed_mps: Option<f64>,
}

/// Points of one row of the table.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartPoints {
    /// Key of the row: `score`, `time_s`, `clearance_m`, `speed_mps`.
    pub part: String,
    /// Figure; absent if no flight finished.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub value: Option<f64>,
    /// Points given.
    pub points: f64,
    /// Maximum points.
    pub of: f64,
    /// Reason for missing points; absent if all are given.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub missing: Option<String>,
}

impl Bounds {
    /// Returns the points for a figure.
    #[must_use]
    pub fn points_for(&self, value: f64) -> f64 {
        let share = 0.5 + 0.5 * (value - self.half) / (self.all - self.half);
        self.points * share.clamp(0.0, 1.0)
    }

    /// Returns the figure at which the points reach 0.
    #[must_use]
    pub fn none(&self) -> f64 {
        2.0 * self.half - self.all
    }
}

impl PointsTable {
    /// Checks that points are in range, and that bounds are in the right order for their figure.
    ///
    /// # Errors
    /// The first wrong key, with its valid range.
    pub fn check(&self) -> Result<(), String> {
        let is_points = |points: f64| (0.0..=1000.0).contains(&points);
        let bounds =
            self.rows().flat_map(|(_, Bounds { points, all, half }, _)| [points, all, half]);
        for number in [self.score, self.least_score].into_iter().chain(bounds) {
            // The numbers are signed, so each must survive a round trip through text exactly.
            if !(number.abs() < 1e6) || millionth(number) != number {
                return Err(format!(
                    "points: {number} is too large, or has more than six digits after the decimal point"
                ));
            }
        }
        if !is_points(self.score) {
            return Err(format!("points.score is {}: give 0 to 1000", self.score));
        }
        if !(0.0..=100.0).contains(&self.least_score) {
            return Err(format!("points.least_score is {}: give 0 to 100", self.least_score));
        }
        for (key, bounds, rises) in self.rows() {
            let Bounds { points, all, half } = bounds;
            if !is_points(points) {
                return Err(format!("points.{key}.points is {points}: give 0 to 1000"));
            }
            let in_order = if rises { all > half } else { all < half };
            if !in_order {
                let order = if rises { "greater" } else { "less" };
                return Err(format!(
                    "points.{key}: all ({all}) must be {order} than half ({half})"
                ));
            }
        }
        Ok(())
    }

    /// Returns the maximum of all points.
    #[must_use]
    pub fn most(&self) -> f64 {
        self.score + self.rows().map(|(_, bounds, _)| bounds.points).sum::<f64>()
    }

    /// Returns the points of each row for these figures, in the order of the table.
    #[must_use]
    pub fn parts(&self, figures: &Figures) -> Vec<PartPoints> {
        let part = |part: &str, value, points: f64, of, missing| PartPoints {
            part: part.to_owned(),
            value,
            points: millionth(points),
            of,
            missing,
        };
        let mut parts = Vec::with_capacity(4);
        if self.score > 0.0 {
            let points = self.score * (figures.score / 100.0).clamp(0.0, 1.0);
            let missing = (figures.score < 100.0).then(|| "a score of 100 gives all".to_owned());
            parts.push(part("score", Some(figures.score), points, self.score, missing));
        }
        for (key, bounds, rises) in self.rows() {
            let (value, unit) = match key {
                "time_s" => (figures.time_s, "s"),
                "clearance_m" => (figures.clearance_m, "m"),
                _ => (figures.speed_mps, "m/s"),
            };
            let (points, missing) = match value {
                _ if figures.score < self.least_score => {
                    (0.0, Some(format!("counts from a score of {} on", self.least_score)))
                }
                None => (0.0, Some("no flight finished".to_owned())),
                Some(value) => {
                    let points = bounds.points_for(value);
                    let way = if rises { "or more" } else { "or less" };
                    let missing = || format!("{} {unit} {way} gives all", bounds.all);
                    (points, (points < bounds.points).then(missing))
                }
            };
            parts.push(part(key, value, points, bounds.points, missing));
        }
        parts
    }

    /// Returns rows with bounds: key, bounds, and whether more is better.
    fn rows(&self) -> impl Iterator<Item = (&'static str, Bounds, bool)> {
        let rows = [
            ("time_s", self.time_s, false),
            ("clearance_m", self.clearance_m, true),
            ("speed_mps", self.speed_mps, true),
        ];
        rows.into_iter().filter_map(|(key, bounds, rises)| Some((key, bounds?, rises)))
    }
}

fn millionth(number: f64) -> f64 {
    (number * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    const TABLE: PointsTable = PointsTable {
        score: 40.0,
        least_score: 50.0,
        time_s: Some(Bounds { points: 10.0, all: 20.0, half: 30.0 }),
        clearance_m: Some(Bounds { points: 10.0, all: 0.15, half: 0.05 }),
        speed_mps: None,
    };

    fn points(figures: &Figures) -> Vec<f64> {
        TABLE.parts(figures).iter().map(|part| part.points).collect()
    }

    #[test]
    fn figures_give_points_in_proportion() {
        let of = |score, time_s, clearance_m| {
            points(&Figures { score, time_s, clearance_m, speed_mps: Some(9.0) })
        };
        assert_eq!(of(100.0, Some(18.0), Some(0.2)), [40.0, 10.0, 10.0]);
        assert_eq!(of(75.0, Some(30.0), Some(0.1)), [30.0, 5.0, 7.5]);
        assert_eq!(of(50.0, Some(45.0), Some(-0.1)), [20.0, 0.0, 0.0]);
        assert_eq!(of(49.0, Some(18.0), Some(0.2)), [19.6, 0.0, 0.0], "less than half is passed");
        assert_eq!(of(60.0, None, None), [24.0, 0.0, 0.0]);
        assert!((TABLE.most() - 60.0).abs() < 1e-9);
        assert!((TABLE.time_s.unwrap().none() - 40.0).abs() < 1e-9);
    }

    #[test]
    fn explains_missing_points() {
        let said = |figures: &Figures| -> Vec<String> {
            TABLE.parts(figures).into_iter().filter_map(|part| part.missing).collect()
        };
        let good =
            Figures { score: 100.0, time_s: Some(20.0), clearance_m: Some(0.15), speed_mps: None };
        assert_eq!(said(&good), Vec::<String>::new());
        let late = said(&Figures { time_s: Some(24.0), ..good });
        assert_eq!(late, ["20 s or less gives all"]);
        let poor = said(&Figures { score: 20.0, ..good });
        assert_eq!(poor.len(), 3);
        assert!(poor[1].contains("from a score of 50"), "{poor:?}");
    }

    #[test]
    fn rejects_wrong_tables_by_key() {
        assert_eq!(TABLE.check(), Ok(()));
        let refused = |table: PointsTable, word: &str| {
            let error = table.check().unwrap_err();
            assert!(error.contains(word), "{error}");
        };
        refused(PointsTable { score: -1.0, ..TABLE }, "points.score");
        refused(PointsTable { least_score: 101.0, ..TABLE }, "least_score");
        refused(PointsTable { least_score: f64::NAN, ..TABLE }, "NaN");
        refused(PointsTable { score: 1.0 / 3.0, ..TABLE }, "six digits");
        let turned = Bounds { points: 10.0, all: 30.0, half: 20.0 };
        refused(PointsTable { time_s: Some(turned), ..TABLE }, "must be less than half");
        let same = Bounds { points: 10.0, all: 0.1, half: 0.1 };
        refused(PointsTable { clearance_m: Some(same), ..TABLE }, "must be greater than half");
        let much = Bounds { points: f64::INFINITY, ..same };
        refused(PointsTable { speed_mps: Some(much), ..TABLE }, "too large");
        let less = Bounds { points: -1.0, ..same };
        refused(PointsTable { speed_mps: Some(less), ..TABLE }, "speed_mps.points");
    }
}
