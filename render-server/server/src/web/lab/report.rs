//! Report of the lab day: every check with evidence and time, the queue, and the log; A4, as PDF (ISO 32000-1).
//!
//! Lines are laid out first ([`lay_out`]), then split into pages ([`paginate`]) and drawn. Text is Helvetica, which
//! every PDF reader has, in Latin letters; other letters become question marks.

use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str, TextStr};
use vizflyt_protocol::time::Civil;

use crate::flights::lab_day::{Booking, BookingState, CHECKS, CheckInfo, LabDay, State};

pub(in crate::web) fn pdf(
    day: &LabDay,
    arena: &str,
    vehicles: &[&str],
    now_unix_ms: u64,
) -> Vec<u8> {
    let title = format!("VizFlyt lab day, {}", date(day.began_unix_ms));
    let foot = format!("{arena}; printed {}", time(now_unix_ms));
    draw(&title, &foot, &paginate(lay_out(day, &title, &foot, vehicles, now_unix_ms)))
}

#[derive(Clone, Debug, PartialEq)]
struct Line {
    kind: LineKind,
    /// Texts with their start. [points from the left margin]
    cells: Vec<(f32, String)>,
    state: Option<State>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum LineKind {
    Title,
    Heading,
    /// A check or a booking, followed by its small print.
    Row,
    Small,
}

impl LineKind {
    /// Returns font size and distance to the line above. [points]
    fn size(self) -> (f32, f32) {
        match self {
            Self::Title => (18.0, 22.0),
            Self::Heading => (12.0, 26.0),
            Self::Row => (10.0, 17.0),
            Self::Small => (8.5, 11.0),
        }
    }
}

fn line(kind: LineKind, text: impl Into<String>) -> Line {
    Line { kind, cells: vec![(0.0, text.into())], state: None }
}

/// Returns all lines, wrapped to the width of the paper.
fn lay_out(
    day: &LabDay,
    title: &str,
    foot: &str,
    vehicles: &[&str],
    now_unix_ms: u64,
) -> Vec<Line> {
    let mut lines = vec![line(LineKind::Title, title), line(LineKind::Row, foot)];
    let group = |lines: &mut Vec<Line>, name: &str, of_room: bool| {
        lines.push(line(
            LineKind::Heading,
            if of_room { "The room".to_owned() } else { format!("Vehicle {name}") },
        ));
        for info in CHECKS.iter().filter(|info| info.of_room == of_room) {
            check(lines, day, if of_room { "" } else { name }, info, now_unix_ms);
        }
    };
    group(&mut lines, "", true);
    for name in vehicles {
        group(&mut lines, name, false);
    }
    lines.push(line(LineKind::Heading, "Several vehicles"));
    let order = if day.order.vehicles.is_empty() {
        "none".to_owned()
    } else {
        day.order.vehicles.join(", ")
    };
    let separation =
        day.separation_m.map_or("not watched".to_owned(), |m| format!("{m} m between centres"));
    small(&mut lines, 0.0, &format!("Order of take-off: {order}. Least separation: {separation}."));
    lines.push(line(LineKind::Heading, "Queue"));
    for booking in day.queue.bookings() {
        booked(&mut lines, booking);
    }
    if day.queue.bookings().is_empty() {
        small(&mut lines, 0.0, "No bookings.");
    }
    lines.push(line(LineKind::Heading, "What happened"));
    if day.story().next().is_none() {
        small(&mut lines, 0.0, "Nothing yet.");
    }
    for told in day.story() {
        let wrapped = wrap(&told.text, LineKind::Small.size().0, WIDTH - STORY_AT);
        for (at, text) in wrapped.into_iter().enumerate() {
            let mut cells = vec![(STORY_AT, text)];
            if at == 0 {
                cells.insert(0, (0.0, time(told.at_unix_ms)));
            }
            lines.push(Line { kind: LineKind::Small, cells, state: None });
        }
    }
    lines
}

fn check(lines: &mut Vec<Line>, day: &LabDay, vehicle: &str, info: &CheckInfo, now_unix_ms: u64) {
    let state = day.state(vehicle, info.id, now_unix_ms);
    let record = day.evidence(vehicle, info.id);
    let when = record.map_or_else(String::new, |record| time(record.at_unix_ms));
    // On paper an outdated check cannot be repeated: show its last result.
    let words = match record.filter(|_| state == State::Outdated) {
        Some(record) if record.finding.ok => "was ok",
        Some(_) => "had failed",
        None => state.words(),
    };
    let cells = vec![(0.0, words.to_owned()), (NAME_AT, info.title.to_owned()), (TIME_AT, when)];
    lines.push(Line { kind: LineKind::Row, cells, state: Some(state) });
    match record {
        Some(record) => {
            small(lines, NAME_AT, &format!("{} ({})", record.finding.evidence, record.by));
            if !record.finding.todo.is_empty() {
                small(lines, NAME_AT, &format!("To do: {}", record.finding.todo));
            }
        }
        None => small(lines, NAME_AT, &format!("To do: {}", info.ask)),
    }
}

fn booked(lines: &mut Vec<Line>, booking: &Booking) {
    let state = match booking.state {
        BookingState::Waiting => "waits",
        BookingState::Called => "its turn",
        BookingState::Done => "has flown",
        BookingState::Withdrawn => "left",
    };
    let hour = |unix_ms: Option<u64>| {
        unix_ms.map_or("-".to_owned(), |unix_ms| time(unix_ms)[11..].to_owned())
    };
    let passed = match booking.passed_over {
        0 => String::new(),
        times => format!(", passed over {times} times"),
    };
    let name = format!("{} on {}", booking.team, booking.vehicle);
    for (at, text) in wrap(&name, LineKind::Row.size().0, WIDTH - NAME_AT).into_iter().enumerate() {
        let mut cells = vec![(NAME_AT, text)];
        if at == 0 {
            cells.insert(0, (0.0, state.to_owned()));
        }
        lines.push(Line { kind: LineKind::Row, cells, state: None });
    }
    let times = format!(
        "booked {}, called {}, ended {}{passed}",
        hour(Some(booking.booked_unix_ms)),
        hour(booking.called_unix_ms),
        hour(booking.ended_unix_ms)
    );
    small(lines, NAME_AT, &times);
}

/// Adds wrapped small text.
fn small(lines: &mut Vec<Line>, at: f32, text: &str) {
    let wrapped = wrap(text, LineKind::Small.size().0, WIDTH - at);
    lines.extend(wrapped.into_iter().map(|text| Line {
        kind: LineKind::Small,
        cells: vec![(at, text)],
        state: None,
    }));
}

/// Splits lines into pages: a heading stays with the next block, and a row with its small print.
fn paginate(lines: Vec<Line>) -> Vec<Vec<Line>> {
    let mut pages = vec![Vec::new()];
    let mut left = HEIGHT;
    let mut lines = lines.into_iter().peekable();
    while let Some(first) = lines.next() {
        // Lines that stay on one page.
        let mut block = vec![first];
        let is_story = |line: &Line| line.kind == LineKind::Small && line.cells.len() > 1;
        while let Some(next) = lines.peek() {
            let last = block[block.len() - 1].kind;
            let follows = match (last, next.kind) {
                (LineKind::Heading, _) => true,
                (LineKind::Row | LineKind::Small, LineKind::Small) => !is_story(next),
                _ => false,
            };
            if !follows || block.len() >= BLOCK {
                break;
            }
            block.extend(lines.next());
        }
        let high: f32 = block.iter().map(|line| line.kind.size().1).sum();
        if high > left {
            pages.push(Vec::new());
            left = HEIGHT;
        }
        left -= high;
        if let Some(page) = pages.last_mut() {
            page.extend(block);
        }
    }
    pages
}

fn draw(title: &str, foot: &str, pages: &[Vec<Line>]) -> Vec<u8> {
    let mut next = 0;
    let mut reference = || {
        next += 1;
        Ref::new(next)
    };
    let (catalog, tree, info) = (reference(), reference(), reference());
    let fonts = [reference(), reference()];
    let refs: Vec<(Ref, Ref)> = pages.iter().map(|_| (reference(), reference())).collect();
    let mut pdf = Pdf::new();
    pdf.catalog(catalog).pages(tree);
    pdf.document_info(info).title(TextStr(title));
    pdf.pages(tree).kids(refs.iter().map(|&(page, _)| page)).count(pages.len() as i32);
    for (font, name) in fonts.into_iter().zip(["Helvetica", "Helvetica-Bold"]) {
        pdf.type1_font(font)
            .base_font(Name(name.as_bytes()))
            .encoding_predefined(Name(b"WinAnsiEncoding"));
    }
    for (number, (page, &(page_ref, content_ref))) in pages.iter().zip(&refs).enumerate() {
        let mut written = pdf.page(page_ref);
        written.media_box(Rect::new(0.0, 0.0, PAPER.0, PAPER.1)).parent(tree).contents(content_ref);
        let mut resources = written.resources();
        resources.fonts().pair(PLAIN, fonts[0]).pair(BOLD, fonts[1]);
        resources.finish();
        written.finish();
        let foot = format!("{title}; {foot}; page {} of {}", number + 1, pages.len());
        pdf.stream(content_ref, &draw_page(page, &foot));
    }
    pdf.finish()
}

fn draw_page(lines: &[Line], foot: &str) -> Vec<u8> {
    let mut content = Content::new();
    let mut show = |font, size: f32, [x, y]: [f32; 2], [r, g, b]: [f32; 3], text: &str| {
        content.set_fill_rgb(r, g, b).begin_text().set_font(font, size);
        content.next_line(x, y).show(Str(&latin(text))).end_text();
    };
    let mut y = PAPER.1 - MARGIN;
    for line in lines {
        let (size, down) = line.kind.size();
        y -= down;
        let font =
            if matches!(line.kind, LineKind::Title | LineKind::Heading) { BOLD } else { PLAIN };
        for (at, (x, text)) in line.cells.iter().enumerate() {
            match line.state.filter(|_| at == 0) {
                Some(state) => show(BOLD, size, [MARGIN + x, y], colour(state), text),
                None => show(font, size, [MARGIN + x, y], BLACK, text),
            }
        }
    }
    show(PLAIN, 7.5, [MARGIN, 0.5 * MARGIN], GREY, foot);
    content.finish().into_vec()
}

/// Returns a state's colour, dark enough for a black-and-white printer.
fn colour(state: State) -> [f32; 3] {
    match state {
        State::Ok => [0.0, 0.4, 0.15],
        State::Failed => [0.7, 0.0, 0.0],
        State::Outdated => [0.6, 0.35, 0.0],
        State::NotDone => [0.35, 0.35, 0.35],
    }
}

/// Returns text in WinAnsi encoding, which equals Latin-1 for the supported letters.
fn latin(text: &str) -> Vec<u8> {
    let byte = |c: char| match u32::from(c) {
        code @ (0x20..=0x7e | 0xa0..=0xff) => code as u8,
        _ => b'?',
    };
    text.chars().map(byte).collect()
}

/// Splits text into lines of at most `width` [points], at spaces if possible.
fn wrap(text: &str, size: f32, width: f32) -> Vec<String> {
    let mut lines = Vec::new();
    let mut line = String::new();
    for word in text.split(' ') {
        let longer = if line.is_empty() { word.to_owned() } else { format!("{line} {word}") };
        if wide(&longer, size) <= width {
            line = longer;
            continue;
        }
        if !line.is_empty() {
            lines.push(std::mem::take(&mut line));
        }
        for c in word.chars() {
            line.push(c);
            if wide(&line, size) > width {
                line.pop();
                lines.push(std::mem::replace(&mut line, c.to_string()));
            }
        }
    }
    lines.push(line);
    lines
}

/// Returns the width of text in Helvetica. [points]
fn wide(text: &str, size: f32) -> f32 {
    let of = |byte: u8| match byte {
        0x20..=0x7e => WIDTHS[usize::from(byte - 0x20)],
        // Accented letters are at most as wide as a capital.
        _ => 722,
    };
    latin(text).into_iter().map(|byte| f32::from(of(byte))).sum::<f32>() * size * 1e-3
}

/// Formats a date as `2026-11-26`.
fn date(unix_ms: u64) -> String {
    let Civil { year, month, day, .. } = Civil::of_unix(unix_ms / 1000);
    format!("{year:04}-{month:02}-{day:02}")
}

/// Formats a time as `2026-11-26 14:05:09 UTC`.
fn time(unix_ms: u64) -> String {
    let Civil { hour, minute, second, .. } = Civil::of_unix(unix_ms / 1000);
    format!("{} {hour:02}:{minute:02}:{second:02} UTC", date(unix_ms))
}

const PLAIN: Name<'static> = Name(b"F1");
const BOLD: Name<'static> = Name(b"F2");
const BLACK: [f32; 3] = [0.0; 3];
const GREY: [f32; 3] = [0.35; 3];
/// Paper size A4. [points]
const PAPER: (f32, f32) = (595.0, 842.0);
const MARGIN: f32 = 50.0;
const WIDTH: f32 = PAPER.0 - 2.0 * MARGIN;
const HEIGHT: f32 = PAPER.1 - 2.0 * MARGIN;
/// Columns. [points from the left margin]
const NAME_AT: f32 = 60.0;
const TIME_AT: f32 = 370.0;
const STORY_AT: f32 = 120.0;
/// Maximum number of lines that stay together.
const BLOCK: usize = 20;
/// Widths of Helvetica's letters from space to tilde, from Adobe's metrics (Helvetica.afm). [1/1000 of the size]
const WIDTHS: [u16; 95] = [
    278, 278, 355, 556, 556, 889, 667, 191, 333, 333, 389, 584, 278, 333, 278, 278, 556, 556, 556,
    556, 556, 556, 556, 556, 556, 556, 278, 278, 584, 584, 584, 556, 1015, 667, 667, 722, 722, 667,
    611, 778, 722, 278, 500, 667, 556, 833, 722, 778, 667, 778, 722, 667, 611, 722, 667, 944, 667,
    667, 611, 278, 278, 278, 469, 556, 333, 556, 556, 500, 556, 556, 278, 556, 556, 222, 222, 500,
    222, 833, 556, 556, 556, 556, 333, 500, 278, 556, 500, 722, 500, 500, 500, 334, 260, 334, 584,
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::flights::lab_day::{CheckId, Finding};

    fn day(stories: usize) -> LabDay {
        let mut day = LabDay::new(1_795_703_400_000);
        day.record(
            "",
            CheckId::Net,
            Finding::of("looked at by Ada Lovelace".to_owned(), &[]),
            "Ada Lovelace",
            1_795_703_460_000,
        );
        let late =
            Finding::of("images are 40 ms old".to_owned(), &["look at the network ".repeat(12)]);
        day.record("wasp", CheckId::Latency, late, "the server", 1_795_703_470_000);
        day.queue.book("les abeilles d'été", "wasp", 1_795_703_480_000).unwrap();
        day.queue.book("μέλισσες", "wasp", 1_795_703_490_000).unwrap();
        for n in 0..stories {
            day.tell(
                format!("something of number {n}: {}", "words ".repeat(n % 40)),
                1_795_703_500_000,
            );
        }
        day
    }

    fn pages(stories: usize) -> Vec<Vec<Line>> {
        paginate(lay_out(&day(stories), "title", "foot", &["wasp", "bee"], 1_795_703_600_000))
    }

    #[test]
    fn lists_every_check_with_state_evidence_and_time() {
        let all: Vec<_> = pages(3).concat();
        let rows: Vec<_> = all.iter().filter(|line| line.state.is_some()).collect();
        let of_room = CHECKS.iter().filter(|info| info.of_room).count();
        assert_eq!(rows.len(), of_room + 2 * (CHECKS.len() - of_room));
        let text = all
            .iter()
            .flat_map(|line| &line.cells)
            .map(|(_, text)| text.as_str())
            .collect::<Vec<_>>()
            .join("\n");
        for expected in [
            "net closed",
            "had failed",
            "2026-11-26 14:31:00 UTC",
            "looked at by Ada Lovelace (Ada Lovelace)",
            "To do: look at the network",
            "les abeilles d'été on wasp",
            "something of number 2",
        ] {
            assert!(text.contains(expected), "{expected} is not in\n{text}");
        }
    }

    #[test]
    fn no_line_is_too_wide_and_no_page_too_high() {
        let pages = pages(400);
        assert!(pages.len() > 5, "{}", pages.len());
        for page in &pages {
            let high: f32 = page.iter().map(|line| line.kind.size().1).sum();
            assert!(high <= HEIGHT && !page.is_empty(), "{high}");
            // A heading is never the last line of a page.
            assert_ne!(page.last().map(|line| line.kind), Some(LineKind::Heading));
            for line in page {
                for (at, text) in &line.cells {
                    let end = at + wide(text, line.kind.size().0);
                    assert!(end <= WIDTH + 0.1, "{end}: {text}");
                }
            }
        }
    }

    #[test]
    fn the_file_is_a_pdf_of_latin_letters() {
        let bytes = pdf(&day(3), "hall", &["wasp"], 1_795_703_500_000);
        assert!(bytes.starts_with(b"%PDF-") && bytes.trim_ascii_end().ends_with(b"%%EOF"));
        let has = |what: &[u8]| bytes.windows(what.len()).any(|window| window == what);
        assert!(has(b"net closed") && has(b"/WinAnsiEncoding"));
        assert!(has(b"???????? on wasp"), "Greek letters are not Latin-1");
    }

    #[test]
    fn splits_words_that_are_too_long() {
        assert_eq!(wrap("", 10.0, 50.0), [""]);
        let lines = wrap(&"w".repeat(30), 10.0, 50.0);
        assert_eq!(lines.concat().len(), 30);
        assert!(lines.len() > 3 && lines.iter().all(|line| wide(line, 10.0) <= 50.0), "{lines:?}");
    }
}
