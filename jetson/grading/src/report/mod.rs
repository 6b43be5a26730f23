//! The report: one folder that opens in any browser without network. Contains the results, a table
//! of all flights, and a card for each flight, failed ones first.

pub(crate) mod card;

use std::fmt::Write;

use anyhow::Result;
use ed25519_dalek::SigningKey;
use vizflyt_protocol::messages::OutcomeKind;

use super::document::{Grade, Run, SignedFile, VariantSummary};
use super::figures::{figure, name_of};
use super::folder::{GRADE, JUNIT, PAGE, ReportFolder, sorted};
use super::junit;
use super::statistics::Interval;

const CSS: &str = include_str!("page.css");

/// Writes `index.html` and `junit.xml` into the folder, signs the grade with all files, and writes
/// `grade.json` last. `files`: existing files; `cards`: HTML of [`card::write`], in the order of
/// the flights.
///
/// # Errors
/// If a file cannot be written.
pub(crate) fn write(
    folder: &ReportFolder,
    grade: &mut Grade,
    key: Option<&SigningKey>,
    cards: &[String],
    mut files: Vec<SignedFile>,
) -> Result<()> {
    if let Some(key) = key {
        // Signed here because the page contains the public key.
        grade.sign(key)?;
    }
    files.push(folder.write(PAGE, page(grade, cards).as_bytes())?);
    files.push(folder.write(JUNIT, junit::text(grade).as_bytes())?);
    grade.files = sorted(files);
    if let Some(key) = key {
        grade.sign(key)?;
    }
    folder.write(GRADE, grade.to_text()?.as_bytes())?;
    Ok(())
}

fn page(grade: &Grade, cards: &[String]) -> String {
    let subject = &grade.subject;
    let title = format!("{} in {}", escape(&subject.plugin), escape(&subject.project));
    let part = grade.shard.map_or(String::new(), |shard| {
        format!(" <span class=\"faint\">(part {} of {})</span>", shard.index, shard.count)
    });
    let mut text = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         <meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src 'self'; \
         style-src 'unsafe-inline'\"><title>Grade: {title}</title><style>{CSS}</style></head><body>\n\
         <h1>{title}{part}</h1><p class=\"faint\">level {}, {} flights of {}</p>\n",
        subject.level.to_uppercase(),
        grade.runs.len(),
        escape(&subject.variants.join(", "))
    );
    text += &figures(grade);
    text += &points(grade);
    text += &variants(grade);
    text += &table(&grade.runs, !cards.is_empty());
    let with_cards = || grade.runs.iter().zip(cards);
    for (finished, title) in
        [(false, "Flights that did not finish"), (true, "Flights that finished")]
    {
        let mut cards = with_cards()
            .filter(|(run, _)| (run.outcome == OutcomeKind::Finished) == finished)
            .map(|(_, card)| card.as_str())
            .peekable();
        if cards.peek().is_some() {
            let _ = writeln!(text, "<h2>{title}</h2>");
            text.extend(cards);
        }
    }
    text += &origins(grade);
    text + "</body></html>\n"
}

fn figures(grade: &Grade) -> String {
    let summary = &grade.summary;
    let span = |found: &Interval, digits: usize, scale: f64, unit: &str| {
        format!("95 %: {:.digits$} to {:.digits$}{unit}", found.low * scale, found.high * scale)
    };
    let metres = |value: Option<f64>| value.map_or("-".to_owned(), |m| format!("{m:.2} m"));
    let seconds = |value: Option<f64>| value.map_or("-".to_owned(), |s| format!("{s:.1} s"));
    let stages = grade.runs.first().map_or(0, |run| run.stages.len());
    let boxes = [
        ("Score", format!("{:.1}", summary.score.value), span(&summary.score, 1, 1.0, "")),
        (
            "Finished",
            format!("{} of {}", summary.finished, summary.runs),
            span(&summary.finish_share, 0, 100.0, " %"),
        ),
        (
            "Stages passed",
            format!("{:.2}", summary.mean_stages_passed),
            format!("of {stages}, on average"),
        ),
        ("Time to finish", seconds(summary.mean_finish_s), "mean, penalties included".to_owned()),
        ("Least clearance", metres(summary.min_clearance_m), "of all flights".to_owned()),
    ];
    let mut text = "<dl class=\"figures\">".to_owned();
    for (name, value, note) in boxes {
        let _ = write!(text, "<div><dt>{name}</dt><dd>{value}<small>{note}</small></dd></div>");
    }
    text + "</dl>\n"
}

/// Returns the table of points with what is missing for more, if the project has points.
fn points(grade: &Grade) -> String {
    let Some((points, most)) = grade.all_points() else { return String::new() };
    let mut text = format!(
        "<div class=\"wide\"><table><thead><tr><th class=\"text\">Part</th><th>Points</th><th>Figure</th>\
         <th class=\"text\">Missing</th></tr></thead><tbody>\n<tr><td class=\"text\">all</td>\
         <td>{points:.1} of {most:.0}</td><td></td><td></td></tr>\n"
    );
    for part in &grade.points {
        let value = part.value.map_or("-".to_owned(), |value| figure(&part.part, value));
        let _ = writeln!(
            text,
            "<tr><td class=\"text\">{}</td><td>{:.1} of {:.0}</td><td>{value}</td><td class=\"text why\">{}</td></tr>",
            escape(name_of(&part.part)),
            part.points,
            part.of,
            escape(part.missing.as_deref().unwrap_or_default())
        );
    }
    text + "</tbody></table></div>\n"
}

/// Returns the table of variants, if there are several, with the settings of random ones.
fn variants(grade: &Grade) -> String {
    if grade.by_variant.is_empty() {
        return String::new();
    }
    let mut text = "<div class=\"wide\"><table><thead><tr><th class=\"text\">Variant</th>\
                    <th>Finished</th><th>Score</th><th>95 %</th><th class=\"text\">Description</th>\
                    </tr></thead><tbody>\n"
        .to_owned();
    for VariantSummary { variant, summary } in &grade.by_variant {
        let drawn = grade.subject.environments.get(variant);
        let what = drawn.and_then(|drawn| serde_json::to_string(drawn).ok()).unwrap_or_default();
        let _ = writeln!(
            text,
            "<tr><td class=\"text\">{}</td><td>{} of {}</td><td>{:.1}</td><td>{:.1} to {:.1}</td>\
             <td class=\"text why\">{}</td></tr>",
            escape(variant),
            summary.finished,
            summary.runs,
            summary.score.value,
            summary.score.low,
            summary.score.high,
            escape(&what)
        );
    }
    text + "</tbody></table></div>\n"
}

fn table(runs: &[Run], with_cards: bool) -> String {
    let mut text = "<div class=\"wide\"><table><thead><tr><th class=\"text\">Seed</th>\
                    <th class=\"text\">Variant</th><th class=\"text\">Outcome</th><th>Stages</th>\
                    <th>Time</th><th>Clearance</th><th>Speed</th><th>Score</th>\
                    <th class=\"text\">Why</th></tr></thead><tbody>\n"
        .to_owned();
    for run in runs {
        let Run { seed, outcome, .. } = run;
        let variant = escape(&run.variant);
        let mut stages = String::new();
        for stage in &run.stages {
            let (class, when) = match stage.passed_s {
                Some(s) => ("stage passed", format!("{s:.1} s")),
                None => ("stage", "not passed".to_owned()),
            };
            let name = escape(&stage.name);
            let _ = write!(
                stages,
                "<span class=\"{class}\" role=\"img\" title=\"{name}: {when}\" aria-label=\"{name}: \
                 {when}\"></span>"
            );
        }
        if stages.is_empty() {
            stages += "-";
        }
        let seed = if with_cards {
            format!("<a href=\"#{variant}-{seed}\">{seed}</a>")
        } else {
            seed.to_string()
        };
        let clearance =
            run.min_clearance_m.map_or("-".to_owned(), |clearance_m| format!("{clearance_m:.2} m"));
        let why = run.cause.as_deref().unwrap_or(&run.reason);
        let _ = writeln!(
            text,
            "<tr><td class=\"text\">{seed}</td><td class=\"text\">{variant}</td>\
             <td class=\"text outcome {outcome}\">{}</td><td>{stages}</td><td>{:.1} s</td>\
             <td>{clearance}</td><td>{:.1} m/s</td><td>{:.0}</td><td class=\"text why\">{}</td></tr>",
            outcome.name().replace('_', " "),
            run.seconds + run.penalty_s,
            run.max_speed_mps,
            run.score,
            escape(why)
        );
    }
    text + "</tbody></table></div>\n"
}

/// Returns the section with all inputs of the grade, for reproduction.
fn origins(grade: &Grade) -> String {
    let subject = &grade.subject;
    let mut text =
        "<h2>Reproducibility</h2><p>Flown in lock-step: the result does not depend on the speed of the \
                    computer.</p><div class=\"wide\"><table><tbody>"
            .to_owned();
    let delays = subject.delays;
    let rows = [
        ("Hash of all flights", grade.hash.clone()),
        ("Team", subject.team.clone().unwrap_or_else(|| "not given".to_owned())),
        ("Courses", subject.courses()),
        ("Plugin", subject.plugin_sha256.clone()),
        ("Program", format!("{} {}", subject.program, subject.program_sha256)),
        ("Renderer", subject.renderer.clone()),
        (
            "Time model",
            format!(
                "an image every {:.1} ms, {:.1} ms old when the plugin receives it; its answer takes effect {:.1} ms \
                 later",
                delays.image_period, delays.image, delays.answer
            ),
        ),
        (
            "Signed",
            "all files of this folder, in grade.json: vizflyt grade verify with this folder finds any change"
                .to_owned(),
        ),
        (
            "Signed with",
            grade.signature.as_ref().map_or("not signed".to_owned(), |signed| signed.key.clone()),
        ),
    ];
    for (name, value) in rows {
        let _ = write!(
            text,
            "<tr><th class=\"text\">{name}</th><td class=\"text why hash\">{}</td></tr>",
            escape(&value)
        );
    }
    text + "</tbody></table></div>\n"
}

/// Escapes text of a plugin, or other untrusted text, for HTML.
pub(crate) fn escape(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for letter in text.chars() {
        match letter {
            '&' => safe += "&amp;",
            '<' => safe += "&lt;",
            '>' => safe += "&gt;",
            '"' => safe += "&quot;",
            '\'' => safe += "&#39;",
            // Control characters except line breaks and tabs are replaced.
            c if c.is_control() && c != '\n' && c != '\t' => safe.push('\u{fffd}'),
            c => safe.push(c),
        }
    }
    safe
}

#[cfg(test)]
mod tests {
    use super::super::document::tests::{grade, key, run};
    use super::*;

    #[test]
    fn escapes_output_of_a_plugin() {
        assert_eq!(
            escape("<b onload='x'>&\"\u{7}"),
            "&lt;b onload=&#39;x&#39;&gt;&amp;&quot;\u{fffd}"
        );
        let mut grade = grade();
        grade.runs[0].cause = Some("<script>alert(1)</script>".to_owned());
        grade.subject.plugin = "<i>".to_owned();
        let page = page(&grade, &[]);
        assert!(!page.contains("<script") && !page.contains("<i>"), "{page}");
        assert!(page.contains("&lt;script&gt;alert(1)"));
    }

    #[test]
    fn needs_no_network_and_names_every_flight() {
        let temporary = tempfile::tempdir().unwrap();
        let folder = ReportFolder::begin(temporary.path()).unwrap();
        let image = folder.write("images/day-1-00.jpg", b"image").unwrap();
        let mut grade = Grade::new(grade().subject, None, grade().runs);
        let cards = ["day-1", "day-3"].map(|id| format!("<section id=\"{id}\"></section>"));
        super::write(&folder, &mut grade, Some(&key()), &cards, vec![image]).unwrap();
        let page = std::fs::read_to_string(folder.at(PAGE)).unwrap();
        assert!(!page.contains("://"), "no links to other hosts");
        for part in ["1 of 2", "href=\"#day-1\"", "id=\"day-1\"", "too fast", "reached the goal"] {
            assert!(page.contains(part), "{part} is missing");
        }
        // Failed flights come first.
        let place = |text: &str| page.find(text).unwrap();
        assert!(place("did not finish") < place("id=\"day-1\""));
        assert!(place("id=\"day-1\"") < place("Flights that finished"));
        assert!(place("Flights that finished") < place("id=\"day-3\""));
        let read = Grade::read(&folder.at(GRADE)).unwrap();
        assert_eq!(read, grade);
        read.verify(&key().verifying_key()).unwrap();
        assert!(page.contains(&read.signature.as_ref().unwrap().key));
        super::super::folder::verify(temporary.path(), &read).unwrap();
        let paths: Vec<&str> = read.files.iter().map(|file| file.path.as_str()).collect();
        assert_eq!(paths, ["images/day-1-00.jpg", PAGE, JUNIT]);
        let flown = table(&[run(5, OutcomeKind::Finished)], false);
        for part in ["<td class=\"text\">5</td>", "<th class=\"text\">Outcome</th>"] {
            assert!(flown.contains(part), "{part} is missing: {flown}");
        }
    }
}
