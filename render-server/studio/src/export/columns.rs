//! Table of named columns, and its CSV form; `parquet` writes the same table.

use std::fmt::Write;

use glam::{DQuat, DVec3};

/// Values of a column.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Values {
    Integers(Vec<i64>),
    /// NaN: unknown.
    Numbers(Vec<f64>),
    Texts(Vec<String>),
}

/// Columns of equal length.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Table {
    pub(super) columns: Vec<(String, Values)>,
}

impl Table {
    /// Adds a column of integers, for example times. Values beyond 63 bits saturate.
    pub(super) fn integers(&mut self, name: &str, values: impl Iterator<Item = u64>) {
        let values = values.map(|value| i64::try_from(value).unwrap_or(i64::MAX)).collect();
        self.columns.push((name.to_owned(), Values::Integers(values)));
    }

    pub(super) fn numbers(&mut self, name: &str, values: impl Iterator<Item = f64>) {
        self.columns.push((name.to_owned(), Values::Numbers(values.collect())));
    }

    pub(super) fn texts(&mut self, name: &str, values: impl Iterator<Item = String>) {
        self.columns.push((name.to_owned(), Values::Texts(values.collect())));
    }

    /// Adds `NAME_x` to `NAME_z`; unknown values are NaN.
    #[allow(clippy::needless_pass_by_value)] // Why: an iterator, walked once for each axis.
    pub(super) fn vectors(
        &mut self,
        name: &str,
        values: impl Iterator<Item = Option<DVec3>> + Clone,
    ) {
        for (axis, letter) in ["x", "y", "z"].iter().enumerate() {
            let of = |vector: Option<DVec3>| vector.map_or(f64::NAN, |vector| vector[axis]);
            self.numbers(&format!("{name}_{letter}"), values.clone().map(of));
        }
    }

    /// Adds `NAME_qx` to `NAME_qw`; unknown values are NaN.
    #[allow(clippy::needless_pass_by_value)] // Why: an iterator, walked once for each axis.
    pub(super) fn rotations(
        &mut self,
        name: &str,
        values: impl Iterator<Item = Option<DQuat>> + Clone,
    ) {
        for (axis, letter) in ["qx", "qy", "qz", "qw"].iter().enumerate() {
            let of = |rotation: Option<DQuat>| {
                rotation.map_or(f64::NAN, |rotation| rotation.to_array()[axis])
            };
            self.numbers(&format!("{name}_{letter}"), values.clone().map(of));
        }
    }

    /// Returns the number of rows.
    pub(super) fn rows(&self) -> usize {
        self.columns.first().map_or(0, |(_, values)| match values {
            Values::Integers(values) => values.len(),
            Values::Numbers(values) => values.len(),
            Values::Texts(values) => values.len(),
        })
    }

    /// Returns the table as CSV (RFC 4180) with a header; unknown values are empty.
    pub(super) fn to_csv(&self) -> String {
        let names: Vec<&str> = self.columns.iter().map(|(name, _)| name.as_str()).collect();
        let mut text = names.join(",") + "\n";
        for row in 0..self.rows() {
            for (index, (_, values)) in self.columns.iter().enumerate() {
                if index > 0 {
                    text.push(',');
                }
                let _ = match values {
                    Values::Integers(values) => write!(text, "{}", values[row]),
                    Values::Numbers(values) if values[row].is_nan() => Ok(()),
                    Values::Numbers(values) => write!(text, "{}", values[row]),
                    Values::Texts(values) if values[row].contains([',', '"', '\n', '\r']) => {
                        write!(text, "\"{}\"", values[row].replace('"', "\"\""))
                    }
                    Values::Texts(values) => write!(text, "{}", values[row]),
                };
            }
            text.push('\n');
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_quotes_special_characters_and_omits_unknown_values() {
        let mut table = Table::default();
        table.integers("at_ns", [1, u64::MAX].into_iter());
        table.vectors("p", [Some(DVec3::new(0.5, -1.0, 2.0)), None].into_iter());
        table.texts("json", ["{\"a\": 1, \"b\": 2}", "plain"].map(str::to_owned).into_iter());
        let csv = "at_ns,p_x,p_y,p_z,json\n1,0.5,-1,2,\"{\"\"a\"\": 1, \"\"b\"\": 2}\"\n9223372036854775807,,,,plain\n";
        assert_eq!(table.to_csv(), csv);
    }
}
