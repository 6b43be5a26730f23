//! A crash card: what a failed flight looked like at its end.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use anyhow::{Context, Result};
use jpeg_encoder::{ColorType, Encoder};
use vizflyt_arena::crash::{plot, since};
use vizflyt_arena::{ArenaConfig, DistanceField};
use vizflyt_protocol::messages::EventKind;

use super::super::document::Run;
use super::super::trial::TrialResult;
use super::escape;

/// Folder of the images, in the report's.
const IMAGES: &str = "images";
/// Of the images. [0 to 100]
const QUALITY: u8 = 85;
/// Clearance and speed are plotted over so long. [s]
const PLOTTED_S: f64 = 4.0;
/// Events that are shown.
const EVENTS: usize = 12;

/// Writes the images of a failed flight into the report's folder; returns its card as HTML.
pub(crate) fn write(
    folder: &Path,
    arena: &ArenaConfig,
    field: &DistanceField,
    run: &Run,
    flown: &TrialResult,
) -> Result<String> {
    let mut card = head(run);
    let at = flown.verdict.ended;
    if let Some(at) = at {
        card += &strip(folder, run, flown, |stamp| at.seconds_since(stamp))?;
        let last = since(&flown.samples, at, PLOTTED_S);
        let way = since(&flown.samples, at, f64::INFINITY);
        let height_m = last.last().map_or(arena.takeoff_height_m, |sample| sample.p_world_m.z);
        let _ = write!(
            card,
            "<div class=\"plots\"><figure>{}<figcaption>Clearance of the body (blue) and speed (orange) \
             in its last seconds</figcaption></figure><figure>{}<figcaption>From above: obstacles at \
             {height_m:.2} m height, the way flown, and where it ended, with its nose</figcaption>\
             </figure></div>",
            plot::clearance(last, at),
            plot::top_view(arena, &field.obstacle_slice(height_m), last, way)
        );
    }
    let events = flown.events.iter().filter(|event| event.kind != EventKind::PluginOutput);
    let events: Vec<_> = events.filter(|event| at.is_none_or(|at| event.stamp <= at)).collect();
    let mut story = String::new();
    for event in events.iter().skip(events.len().saturating_sub(EVENTS)) {
        let before_s = at.map_or(0.0, |at| at.seconds_since(event.stamp));
        let _ = writeln!(story, "{:>8.2} s  {}", -before_s, escape(event.text.as_str()));
    }
    let _ = write!(card, "<details><summary>What happened</summary><pre>{story}</pre></details>");
    if !flown.lines.is_empty() {
        let lines: Vec<String> = flown.lines.iter().map(|line| escape(line)).collect();
        let _ = write!(
            card,
            "<details><summary>What the plugin printed</summary><pre>{}</pre></details>",
            lines.join("\n")
        );
    }
    Ok(card + "</section>\n")
}

/// Returns the card of a failed flight that another computer has flown, of which only the grade is here.
pub(crate) fn without_images(run: &Run) -> String {
    head(run)
        + "<p class=\"faint\">Merged from parts: its images, clearance and map are in the report of \
           the part that flew it, if that was given <code>--report</code>; or fly this seed again.</p>\
           </section>\n"
}

/// Returns what begins a card: which flight, how it ended, and why.
fn head(run: &Run) -> String {
    let Run { seed, variant, outcome, .. } = run;
    // A part's text is another's: its variant is no name of ours until it is looked at.
    let variant = escape(variant);
    format!(
        "<section class=\"card\" id=\"{variant}-{seed}\"><h3>Seed {seed}, {variant}: \
         <span class=\"outcome {outcome}\">{}</span></h3><p class=\"cause\">{}</p>\
         <p class=\"faint\">{}; {:.1} s after take-off, {} of {} stages</p>",
        outcome.name().replace('_', " "),
        escape(run.cause.as_deref().unwrap_or_default()),
        escape(&run.reason),
        run.seconds,
        run.stages_passed,
        run.stages.len()
    )
}

/// Writes the last images; returns them side by side.
fn strip(
    folder: &Path,
    run: &Run,
    flown: &TrialResult,
    before_s: impl Fn(vizflyt_protocol::time::ServerTime) -> f64,
) -> Result<String> {
    if flown.shots.is_empty() {
        return Ok("<p class=\"faint\">No image was answered.</p>".to_owned());
    }
    let images = folder.join(IMAGES);
    fs::create_dir_all(&images).with_context(|| format!("cannot make {}", images.display()))?;
    let mut strip =
        "<div class=\"strip\" tabindex=\"0\" aria-label=\"its last images\">".to_owned();
    for (index, shot) in flown.shots.iter().enumerate() {
        let name = format!("{}-{}-{index:02}.jpg", run.variant, run.seed);
        let (width, height) = shot.size_px;
        let path = images.join(&name);
        let sizes = u16::try_from(width).ok().zip(u16::try_from(height).ok());
        let (w, h) = sizes.context("an image of more than 65535 px")?;
        let mut bytes = Vec::new();
        Encoder::new(&mut bytes, QUALITY)
            .encode(&shot.rgb, w, h, ColorType::Rgb)
            .with_context(|| format!("cannot encode {name}"))?;
        fs::write(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        let ago_s = before_s(shot.stamp);
        let _ = write!(
            strip,
            "<figure><img src=\"{IMAGES}/{name}\" width=\"{width}\" height=\"{height}\" \
             alt=\"{ago_s:.1} s before the end\" loading=\"lazy\"><figcaption>{:+.1} s</figcaption></figure>",
            -ago_s
        );
    }
    Ok(strip + "</div>")
}

#[cfg(test)]
mod tests {
    use vizflyt_protocol::messages::OutcomeKind;

    use super::super::super::document::tests::run;
    use super::*;

    #[test]
    fn card_without_images_notes_it_and_escapes_a_plugins_markup() {
        let mut failed = run(3, OutcomeKind::Collided);
        failed.reason = "bad <script>".to_owned();
        let card = without_images(&failed);
        assert!(card.starts_with("<section class=\"card\" id=\"day-3\">"), "{card}");
        assert!(card.contains("too fast") && card.contains("bad &lt;script&gt;"), "{card}");
        assert!(
            card.contains("report of the part that flew it") && !card.contains("<img"),
            "{card}"
        );
    }
}
