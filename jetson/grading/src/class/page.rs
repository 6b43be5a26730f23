//! Page with all grades of a class, best first.

use std::fmt::Write;

use super::Graded;
use crate::report::escape;

/// Returns the page. It links to the reports of the teams, in the folder next to it.
pub(super) fn page(all: &[Graded<'_>]) -> String {
    let mut rows: Vec<&Graded<'_>> = all.iter().collect();
    let score =
        |one: &Graded<'_>| one.result.as_ref().map_or(-1.0, |grade| grade.summary.score.value);
    rows.sort_by(|a, b| score(b).total_cmp(&score(a)));
    let about =
        all.iter().find_map(|one| one.result.as_ref().ok()).map_or(String::new(), |grade| {
            let subject = &grade.subject;
            format!(
                "{}, level {}, {} flights each",
                escape(&subject.project),
                subject.level,
                grade.summary.runs
            )
        });
    let mut text = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width, initial-scale=1\"><meta http-equiv=\"Content-Security-Policy\" \
         content=\"default-src 'none'; style-src 'unsafe-inline'\"><title>Grades of a class</title>\
         <style>{STYLE}</style></head><body>\n<h1>Grades of a class</h1><p>{about}</p>\n<table><thead><tr><th>team</th>\
         <th>score</th><th></th><th>finished</th><th>time to the finish</th><th>points</th><th></th></tr></thead><tbody>\n"
    );
    for one in rows {
        let name = escape(&one.team.name);
        let _ = match &one.result {
            Ok(grade) => {
                let summary = &grade.summary;
                let (value, low, high) =
                    (summary.score.value, summary.score.low, summary.score.high);
                let time = summary.mean_finish_s.map_or("-".to_owned(), |s| format!("{s:.1} s"));
                let points = grade.all_points();
                let points = points
                    .map_or("-".to_owned(), |(points, most)| format!("{points:.1} of {most:.0}"));
                let unsigned = if grade.signature.is_some() { "" } else { "not signed" };
                writeln!(
                    text,
                    "<tr><td><a href=\"reports/{name}/index.html\">{name}</a></td><td class=\"number\">{value:.1}</td>\
                     <td><svg viewBox=\"0 0 100 10\" preserveAspectRatio=\"none\" aria-label=\"95 %: {low:.0} to {high:.0}\">\
                     <rect class=\"bar\" width=\"{value:.1}\" height=\"10\"/><rect class=\"range\" x=\"{low:.1}\" y=\"4\" \
                     width=\"{:.1}\" height=\"2\"/></svg></td><td class=\"number\">{} of {}</td><td class=\"number\">{time}</td>\
                     <td class=\"number\">{points}</td><td>{unsigned}</td></tr>",
                    high - low,
                    summary.finished,
                    summary.runs,
                )
            }
            Err(why) => writeln!(
                text,
                "<tr><td>{name}</td><td class=\"number\">0</td><td></td><td></td><td></td><td></td><td class=\"why\">{}</td></tr>",
                escape(why)
            ),
        };
    }
    text + "</tbody></table></body></html>\n"
}

const STYLE: &str = "
:root { color-scheme: light dark; --bar: #4c8bf5; --range: #1b1f24; --line: #d8dee4; }
@media (prefers-color-scheme: dark) { :root { --range: #e6edf3; --line: #30363d; } }
body { font: 15px/1.5 system-ui, sans-serif; max-width: 64rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; width: 100%; } th { text-align: left; font-weight: 600; }
th, td { padding: .35rem .8rem .35rem 0; border-bottom: 1px solid var(--line); } td:nth-child(3) { width: 35%; }
.number { font-variant-numeric: tabular-nums; } .why { font-size: .9em; overflow-wrap: anywhere; }
svg { width: 100%; height: .9rem; display: block; } .bar { fill: var(--bar); } .range { fill: var(--range); }
";
