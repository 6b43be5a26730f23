//! Roster of a class: its teams, and the same table with their results.

use std::path::Path;

use anyhow::{Context, Result, ensure};

use super::Graded;

#[derive(Debug, PartialEq)]
pub(super) struct Team {
    /// Name of the team, of its submission and of its folders.
    pub(super) name: String,
    /// Line of the roster.
    row: Vec<String>,
}

#[derive(Debug, PartialEq)]
pub(super) struct Roster {
    headings: Vec<String>,
    pub(super) teams: Vec<Team>,
}

/// Headings of the added columns.
const ADDED: [&str; 12] = [
    "score",
    "score_low",
    "score_high",
    "finished",
    "flights",
    "mean_finish_s",
    "points",
    "points_of",
    "signed",
    "grade_hash",
    "submission_sha256",
    "note",
];

impl Roster {
    /// Reads a file.
    ///
    /// # Errors
    /// The first error, with its line.
    pub(super) fn read(path: &Path) -> Result<Self> {
        let context = || format!("cannot use {} as a roster", path.display());
        let text = std::fs::read_to_string(path).with_context(context)?;
        Self::parse(&text).with_context(context)
    }

    fn parse(text: &str) -> Result<Self> {
        // Spreadsheets write a byte order mark.
        let mut reader = csv::ReaderBuilder::new()
            .trim(csv::Trim::All)
            .from_reader(text.trim_start_matches('\u{feff}').as_bytes());
        let headings: Vec<String> = reader.headers()?.iter().map(str::to_owned).collect();
        let column = headings.iter().position(|heading| heading.eq_ignore_ascii_case("team"));
        let column = column.context("no column is headed 'team'")?;
        let mut teams: Vec<Team> = Vec::new();
        for record in reader.records() {
            let record = record?;
            let line = record.position().map_or(0, csv::Position::line);
            let name = record[column].to_owned();
            let is_good = !name.starts_with('.')
                && !name.is_empty()
                && name.len() <= 64
                && name.chars().all(|c| c.is_alphanumeric() || "-_. ".contains(c));
            ensure!(
                is_good,
                "line {line}: '{name}' is not a valid team name: use letters, digits, - _ . and spaces, at most 64"
            );
            ensure!(
                teams.iter().all(|team| team.name != name),
                "line {line}: team '{name}' occurs twice"
            );
            teams.push(Team { name, row: record.iter().map(str::to_owned).collect() });
        }
        ensure!(!teams.is_empty(), "the roster contains no team");
        Ok(Self { headings, teams })
    }

    /// Returns the table with the present grades, for spreadsheets.
    pub(super) fn with_grades(&self, graded: &[Graded<'_>]) -> Result<String> {
        let mut table = csv::Writer::from_writer(Vec::new());
        table.write_record(self.headings.iter().map(String::as_str).chain(ADDED))?;
        for one in graded {
            let added: [String; 12] = match &one.result {
                Ok(grade) => {
                    let summary = &grade.summary;
                    let (points, most) = grade.all_points().unzip();
                    let optional = |value: Option<f64>| {
                        value.map_or(String::new(), |value| format!("{value:.1}"))
                    };
                    [
                        format!("{:.1}", summary.score.value),
                        format!("{:.1}", summary.score.low),
                        format!("{:.1}", summary.score.high),
                        summary.finished.to_string(),
                        summary.runs.to_string(),
                        optional(summary.mean_finish_s),
                        optional(points),
                        optional(most),
                        if grade.signature.is_some() { "yes" } else { "no" }.to_owned(),
                        grade.hash.clone(),
                        one.submission.clone(),
                        String::new(),
                    ]
                }
                Err(why) => {
                    let mut added: [String; 12] = Default::default();
                    "0".clone_into(&mut added[0]);
                    added[10].clone_from(&one.submission);
                    // Prefix the text: spreadsheets execute a cell that begins with =.
                    added[11] = format!("no grade: {why}");
                    added
                }
            };
            table.write_record(one.team.row.iter().chain(&added))?;
        }
        Ok(String::from_utf8(table.into_inner()?)?)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn keeps_the_columns_and_reports_errors() {
        let roster =
            Roster::parse("\u{feff}Section, Team ,members\n1, red ,\"A, B\"\n2,blue-2,C\n")
                .unwrap();
        let names: Vec<&str> = roster.teams.iter().map(|team| &*team.name).collect();
        assert_eq!(names, ["red", "blue-2"]);
        let none =
            Graded { team: &roster.teams[0], submission: "ab".into(), result: Err("=1+1".into()) };
        let table = roster.with_grades(&[none]).unwrap();
        let mut lines = table.lines();
        assert!(
            lines.next().unwrap().starts_with("Section,Team,members,score,score_low,"),
            "{table}"
        );
        assert_eq!(lines.next().unwrap(), "1,red,\"A, B\",0,,,,,,,,,,ab,no grade: =1+1");
        for (text, told) in [
            ("name\nred\n", "headed 'team'"),
            ("team\n", "no team"),
            ("team\nred\nred\n", "line 3: team 'red' occurs twice"),
            ("team\n../up\n", "line 2: '../up' is not a valid team name"),
            ("team\n.git\n", "is not a valid team name"),
            ("team,x\nred\n", "1 field"),
        ] {
            let error = format!("{:#}", Roster::parse(text).unwrap_err());
            assert!(error.contains(told), "{text}: {error}");
        }
    }

    proptest! {
        #[test]
        fn rejects_names_that_lead_out_of_a_folder(name in "\\PC{0,20}") {
            if let Ok(roster) = Roster::parse(&format!("team\n{name}\n")) {
                for team in roster.teams {
                    prop_assert!(std::path::Path::new(&team.name).components().count() == 1);
                    prop_assert!(!team.name.contains(['/', '\\', '\0']) && team.name != "..");
                }
            }
        }
    }
}
