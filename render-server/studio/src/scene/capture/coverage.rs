//! Map of a walk from above: path of the camera, gaps without placed pictures, and seen areas.

use std::fmt::Write as _;

use glam::{DVec2, DVec3};

use super::images::{Pictures, clock};
use super::metric::Metric;
use super::unseen::{Area, CELL_M};

/// Returns a map of the walk as SVG: the path coloured by time, points of the room, and tags. A dashed line with times
/// marks missing pictures; unseen areas are shaded. Empty if no picture was placed.
pub(super) fn svg(
    metric: &Metric,
    pictures: &Pictures,
    points: &[DVec3],
    unseen: &[Area],
) -> String {
    let way = &metric.way;
    if way.is_empty() {
        return String::new();
    }
    let top = |p: DVec3| DVec2::new(p.x, p.y);
    let (mut low, mut high) = (DVec2::INFINITY, DVec2::NEG_INFINITY);
    let tags = metric.tags.iter().filter_map(|tag| Some((tag, top(tag.position_m?))));
    for p in way.iter().map(|placed| top(placed.position_m)).chain(tags.clone().map(|(_, p)| p)) {
        (low, high) = (low.min(p), high.max(p));
    }
    let margin_m = 0.15 * (high - low).max_element().max(1.0);
    (low, high) = (low - margin_m, high + margin_m);
    let scale = WIDTH / (high.x - low.x);
    let height = (high.y - low.y) * scale;
    let at = |p: DVec2| ((p.x - low.x) * scale, (high.y - p.y) * scale);
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH:.0} {height:.0}\" role=\"img\" \
         aria-label=\"The walk from above\">"
    );
    // Writing to a string does not fail.
    let every = points.len().div_ceil(MOST_POINTS).max(1);
    for area in unseen {
        for &[from, to, y] in &area.rows_m {
            let (start, end) = (DVec2::new(from, y).max(low), DVec2::new(to, y + CELL_M).min(high));
            if start.cmplt(end).all() {
                let ((x0, y1), (x1, y0)) = (at(start), at(end));
                let _ = write!(
                    svg,
                    "<rect class=unseen x=\"{x0:.1}\" y=\"{y0:.1}\" width=\"{:.1}\" height=\"{:.1}\" \
                     fill=\"#e6d9c8\"/>",
                    x1 - x0,
                    y1 - y0
                );
            }
        }
    }
    svg += "<g fill=\"#8a94a6\">";
    for p in points.iter().step_by(every).map(|p| top(*p)) {
        if p.cmpgt(low).all() && p.cmplt(high).all() {
            let (x, y) = at(p);
            let _ = write!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"0.9\"/>");
        }
    }
    svg += "</g>";
    let index = |name: &str| pictures.pictures.iter().position(|picture| picture.name == name);
    let end_s = pictures.pictures.last().map_or(1.0, |picture| picture.at_s).max(1e-9);
    for pair in way.windows(2) {
        let ((x0, y0), (x1, y1)) = (at(top(pair[0].position_m)), at(top(pair[1].position_m)));
        let missing = match (index(&pair[0].name), index(&pair[1].name)) {
            (Some(a), Some(b)) if b > a + 1 => Some((a + 1, b - 1)),
            _ => None,
        };
        let hue = hue(pair[0].at_s / end_s);
        let style = if missing.is_some() {
            "stroke=\"#d22\" stroke-width=\"2.5\" stroke-dasharray=\"5 4\"".to_owned()
        } else {
            format!("stroke=\"hsl({hue:.0} 75% 42%)\" stroke-width=\"2.5\"")
        };
        let _ = write!(
            svg,
            "<line x1=\"{x0:.1}\" y1=\"{y0:.1}\" x2=\"{x1:.1}\" y2=\"{y1:.1}\" {style}/>"
        );
        if let Some((first, last)) = missing {
            let text = format!("not placed {}", span(pictures, first, last));
            label(&mut svg, f64::midpoint(x0, x1), f64::midpoint(y0, y1), "#d22", &text);
        }
    }
    for placed in way {
        let (x, y) = at(top(placed.position_m));
        let hue = hue(placed.at_s / end_s);
        let ahead = top(placed.ahead).normalize_or_zero() * 9.0;
        let _ = write!(
            svg,
            "<path d=\"M{x:.1} {y:.1}l{:.1} {:.1}\" stroke=\"hsl({hue:.0} 75% 42%)\" stroke-width=\"0.8\"/>\
             <circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.2\" fill=\"hsl({hue:.0} 75% 42%)\"/>",
            ahead.x, -ahead.y
        );
    }
    for (tag, p) in tags {
        let (x, y) = at(p);
        let _ = write!(
            svg,
            "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"8\" height=\"8\"/>",
            x - 4.0,
            y - 4.0
        );
        let number = tag.name.rsplit(' ').next().unwrap_or(&tag.name);
        label(&mut svg, x + 6.0, y - 4.0, "#222", number);
    }
    let (first, last) = (&way[0], &way[way.len() - 1]);
    for placed in [first, last] {
        let (x, y) = at(top(placed.position_m));
        let time = if pictures.of_video { clock(placed.at_s) } else { escaped(&placed.name) };
        label(&mut svg, x + 5.0, y + 12.0, "#06c", &time);
    }
    // Scale bar.
    let metres = [0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0];
    let bar_m = metres.into_iter().find(|m| m * scale > WIDTH / 10.0).unwrap_or(100.0);
    let (right, y) = (12.0 + bar_m * scale, height - 12.0);
    let _ = write!(svg, "<path d=\"M12 {y:.0}H{right:.0}\" stroke=\"#222\" stroke-width=\"2\"/>");
    let guessed = if metric.scale_is_guessed { " (guessed)" } else { "" };
    label(&mut svg, 12.0, y - 5.0, "#222", &format!("{bar_m} m{guessed}"));
    svg + "</svg>"
}

/// Returns the range of a run of pictures, as times of a video or as file names.
pub(super) fn span(pictures: &Pictures, first: usize, last: usize) -> String {
    let place = |i: usize| {
        let picture = &pictures.pictures[i];
        if pictures.of_video { clock(picture.at_s) } else { escaped(&picture.name) }
    };
    let (from, to) = (place(first), place(last));
    if from == to { from } else { format!("{from} to {to}") }
}

/// Returns the hue of a time: from blue at the beginning to red at the end.
fn hue(share: f64) -> f64 {
    230.0 * (1.0 - share.clamp(0.0, 1.0))
}

fn label(svg: &mut String, x: f64, y: f64, colour: &str, text: &str) {
    let _ = write!(
        svg,
        "<text x=\"{x:.1}\" y=\"{y:.1}\" font-size=\"11\" fill=\"{colour}\">{text}</text>"
    );
}

/// Escapes a text for HTML.
pub(super) fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// Width of the map. [px]
const WIDTH: f64 = 860.0;
/// Maximum number of points; more would only enlarge the page.
const MOST_POINTS: usize = 4000;

#[cfg(test)]
mod tests {
    use super::super::images::Picture;
    use super::super::metric::Placed;
    use super::*;

    #[test]
    fn marks_a_gap_with_its_times() {
        let picture = |i: usize| Picture {
            name: format!("{i}.jpg"),
            at_s: i as f64 * 3.0,
            blur: 0.0,
            grey: 0.0,
        };
        let pictures = Pictures {
            folder: "images".into(),
            size_px: [640, 480],
            of_video: true,
            pictures: (0..9).map(picture).collect(),
        };
        let place = |i: usize| Placed {
            name: format!("{i}.jpg"),
            at_s: i as f64 * 3.0,
            position_m: DVec3::new(i as f64, 0.5, 1.4),
            ahead: DVec3::X,
        };
        let mut metric = Metric { way: (0..9).map(place).collect(), ..Metric::default() };
        let whole = svg(&metric, &pictures, &[DVec3::new(1.0, 0.2, 0.0), DVec3::NAN], &[]);
        assert!(!whole.contains("not placed"), "{whole}");
        metric.way.retain(|placed| !(4..=5).contains(&(placed.position_m.x as usize)));
        let unseen = Area {
            min_m: DVec2::new(2.0, 0.0),
            max_m: DVec2::new(3.0, 0.25),
            area_m2: 0.25,
            rows_m: vec![[2.0, 3.0, 0.0], [90.0, 91.0, 0.0]],
        };
        let broken = svg(&metric, &pictures, &[], &[unseen]);
        assert_eq!(broken.matches("class=unseen").count(), 1, "only what is on the map: {broken}");
        assert!(broken.contains("not placed 0:12 to 0:15"), "{broken}");
        assert_eq!(broken.matches("<line").count(), 6);
        metric.way.clear();
        assert_eq!(svg(&metric, &pictures, &[], &[]), "");
        assert_eq!(escaped("<a \"b\" & c>"), "&lt;a &quot;b&quot; &amp; c&gt;");
    }
}
