//! Output of a plugin, line by line: limits length and rate, and reverses Python tracebacks so that
//! the student's own lines come first.

use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use crate::console::printable;

/// Maximum length of a line; the rest is cut. [bytes]
pub const LINE_BYTES: usize = 1024;
/// Maximum rate of lines per stream; further lines are dropped and counted. A plugin that prints one
/// line per image and camera stays below it. [1/s]
const LINES_PER_SECOND: u32 = 200;
/// Maximum length of a traceback that is reversed [lines]. Python itself shortens recursion.
const TRACEBACK_LINES: usize = 200;
/// Maximum number of calls in library code that are shown.
const FOREIGN_CALLS: usize = 6;

/// Reads lines to the end of the pipe, at most [`LINE_BYTES`] of each and [`LINES_PER_SECOND`], without control
/// characters.
pub(super) fn read_lines(pipe: impl Read, mut emit: impl FnMut(String)) {
    let mut reader = BufReader::new(pipe);
    let (mut window, mut passed, mut dropped) = (Instant::now(), 0, 0u64);
    let mut first = true;
    let mut cut = |dropped: u64, emit: &mut dyn FnMut(String)| {
        // Only the first message contains the advice.
        let why = if first { "; printing less per image shows more" } else { "" };
        first = false;
        emit(format!("({dropped} more lines in that second were dropped{why})"));
    };
    while let Ok(Some(line)) = read_line(&mut reader) {
        if window.elapsed() >= Duration::from_secs(1) {
            if dropped > 0 {
                cut(dropped, &mut emit);
            }
            (window, passed, dropped) = (Instant::now(), 0, 0);
        }
        if passed < LINES_PER_SECOND {
            passed += 1;
            emit(printable(line.trim_end_matches('\r')));
        } else {
            dropped += 1;
        }
    }
    if dropped > 0 {
        cut(dropped, &mut emit);
    }
}

/// Reads one line and keeps its first [`LINE_BYTES`], so that memory stays bounded; `None` at the end.
fn read_line(reader: &mut impl BufRead) -> io::Result<Option<String>> {
    let mut line = Vec::new();
    let mut any = false;
    loop {
        let available = match reader.fill_buf() {
            Ok(available) => available,
            Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
            Err(error) => return Err(error),
        };
        if available.is_empty() {
            return Ok(any.then(|| String::from_utf8_lossy(&line).into_owned()));
        }
        any = true;
        let end = available.iter().position(|&byte| byte == b'\n');
        let part = &available[..end.unwrap_or(available.len())];
        let room = LINE_BYTES.saturating_sub(line.len());
        line.extend_from_slice(&part[..part.len().min(room)]);
        let used = end.map_or(available.len(), |end| end + 1);
        reader.consume(used);
        if end.is_some() {
            return Ok(Some(String::from_utf8_lossy(&line).into_owned()));
        }
    }
}

/// Reverses Python tracebacks: first the error, then the student's own lines, innermost first, then
/// calls in library code. Passes all other lines unchanged.
///
/// ```text
/// Traceback (most recent call last):             ValueError: cannot reshape
///   File ".../vizflyt/_run.py", line 40, in run    first.py line 12, in on_image: x.reshape(7)
///     answer = plugin.on_image(obs)          ->    in library code:
///   File "/home/me/first/first.py", line 12, ...     vizflyt/_run.py line 40, in run: answer = ...
///     x.reshape(7)
/// ValueError: cannot reshape
/// ```
#[derive(Debug)]
pub(super) struct Tracebacks {
    own: Vec<PathBuf>,
    held: Option<Vec<String>>,
}

/// The first line of a traceback.
const FIRST: &str = "Traceback (most recent call last):";

struct Call<'a> {
    path: &'a str,
    line: &'a str,
    function: &'a str,
    source: Option<&'a str>,
}

impl Tracebacks {
    /// `own`: folders of the student's code.
    pub(super) fn new(own: Vec<PathBuf>) -> Self {
        Self { own, held: None }
    }

    /// Processes a line of the error output.
    pub(super) fn take(&mut self, line: String, emit: &mut impl FnMut(String)) {
        let Some(held) = &mut self.held else {
            if line == FIRST {
                self.held = Some(vec![line]);
            } else {
                emit(line);
            }
            return;
        };
        let goes_on = line.starts_with("  ") && held.len() < TRACEBACK_LINES;
        if goes_on {
            held.push(line);
            return;
        }
        let held = self.held.take().unwrap_or_default();
        match calls(&held) {
            // A line without indent ends a traceback: `ValueError: ...`.
            Some(calls) if !line.starts_with(' ') && !line.is_empty() => {
                self.innermost_first(&line, &calls, emit);
            }
            _ => held.into_iter().chain([line]).for_each(emit),
        }
    }

    /// Emits the buffered lines at the end of the output.
    pub(super) fn end(self, emit: &mut impl FnMut(String)) {
        self.held.into_iter().flatten().for_each(emit);
    }

    fn innermost_first(&self, what: &str, calls: &[Call], emit: &mut impl FnMut(String)) {
        emit(what.to_owned());
        let (own, foreign): (Vec<&Call>, Vec<&Call>) =
            calls.iter().rev().partition(|call| self.is_own(call.path));
        for call in &own {
            emit(format!("  {}", self.describe(call)));
        }
        if foreign.is_empty() {
            return;
        }
        if !own.is_empty() {
            emit("  in library code:".to_owned());
        }
        for call in foreign.iter().take(FOREIGN_CALLS) {
            emit(format!("    {}", self.describe(call)));
        }
        if foreign.len() > FOREIGN_CALLS {
            emit(format!("    and {} calls more", foreign.len() - FOREIGN_CALLS));
        }
    }

    fn is_own(&self, path: &str) -> bool {
        const FOREIGN: [&str; 3] = ["/site-packages/", "/dist-packages/", "/lib/python"];
        if path.starts_with('<') || FOREIGN.iter().any(|mark| path.contains(mark)) {
            return false;
        }
        let path = Path::new(path);
        path.is_relative() || self.own.iter().any(|folder| path.starts_with(folder))
    }

    /// Returns `first.py line 12, in on_image: x.reshape(7)`, with the path relative to its package.
    fn describe(&self, call: &Call) -> String {
        let path = Path::new(call.path);
        let short = self.own.iter().find_map(|folder| path.strip_prefix(folder).ok());
        let library = |mark: &str| call.path.rsplit_once(mark).map(|(_, rest)| Path::new(rest));
        let short = short
            .filter(|_| self.is_own(call.path))
            .or_else(|| library("-packages/"))
            .unwrap_or(path);
        let source = call.source.map(|source| format!(": {source}")).unwrap_or_default();
        format!("{} line {}, in {}{source}", short.display(), call.line, call.function)
    }
}

/// Parses the calls of a traceback (CPython's `traceback` module, `StackSummary.format`); `None` if the
/// lines are not a traceback.
fn calls(lines: &[String]) -> Option<Vec<Call<'_>>> {
    let mut calls: Vec<Call<'_>> = Vec::new();
    for line in &lines[1..] {
        if let Some(place) = line.strip_prefix("  File \"") {
            let (path, rest) = place.split_once("\", line ")?;
            let (line, function) = rest.split_once(", in ").unwrap_or((rest, "the file"));
            calls.push(Call { path, line, function, source: None });
        } else if let Some(call) = calls.last_mut() {
            // First the source line, then a line of marks.
            call.source = call.source.or(Some(line.trim()));
        }
    }
    (!calls.is_empty()).then_some(calls)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn turned(text: &str) -> Vec<String> {
        let mut seen = Vec::new();
        let mut tracebacks = Tracebacks::new(vec!["/home/me/first".into()]);
        for line in text.lines() {
            tracebacks.take(line.to_owned(), &mut |line| seen.push(line));
        }
        tracebacks.end(&mut |line| seen.push(line));
        seen
    }

    /// Output of Python 3.11.
    const TRACEBACK: &str = r#"before
Traceback (most recent call last):
  File "/usr/lib/python3.11/runpy.py", line 196, in _run_module
    return run()
  File "/home/me/first/first.py", line 30, in on_image
    steer(obs)
    ~~~~~^^^^^
  File "/home/me/first/steering/steer.py", line 12, in steer
    return x.reshape(7)
           ^^^^^^^^^^^^
  File "/home/me/first/.venv/lib/python3.11/site-packages/numpy/core.py", line 5, in reshape
    raise ValueError(text)
ValueError: cannot reshape array
after"#;

    #[test]
    fn shows_the_students_own_lines_first() {
        assert_eq!(
            turned(TRACEBACK),
            [
                "before",
                "ValueError: cannot reshape array",
                "  steering/steer.py line 12, in steer: return x.reshape(7)",
                "  first.py line 30, in on_image: steer(obs)",
                "  in library code:",
                "    numpy/core.py line 5, in reshape: raise ValueError(text)",
                "    /usr/lib/python3.11/runpy.py line 196, in _run_module: return run()",
                "after"
            ]
        );
    }

    #[test]
    fn keeps_incomplete_tracebacks_and_those_without_own_lines() {
        let syntax = "Traceback (most recent call last):\n  File \"<frozen x>\", line 1, in <module>\nImportError: no";
        assert_eq!(turned(syntax), ["ImportError: no", "    <frozen x> line 1, in <module>"]);
        let cut = "Traceback (most recent call last):\n  File \"a.py\", line 1, in f";
        assert_eq!(turned(cut), cut.lines().collect::<Vec<_>>());
        let odd = "Traceback (most recent call last):\nnothing";
        assert_eq!(turned(odd), odd.lines().collect::<Vec<_>>());
        // An endless traceback is not buffered without limit.
        let endless = format!("{FIRST}\n{}", "  x\n".repeat(500));
        assert_eq!(turned(&endless).len(), 501);
    }

    #[test]
    fn reverses_each_traceback_of_a_chain() {
        let one = "Traceback (most recent call last):\n  File \"a.py\", line 1, in f\nKeyError: 1";
        let two = one.replace("KeyError: 1", "ValueError: 2");
        let seen = turned(&format!("{one}\n\nDuring handling of it, another:\n\n{two}"));
        let lines = ["  a.py line 1, in f", "", "During handling of it, another:", ""];
        assert_eq!(seen[0], "KeyError: 1");
        assert_eq!(seen[1..5], lines);
        assert_eq!(seen[5], "ValueError: 2");
    }

    #[test]
    fn drops_and_counts_lines_above_the_maximum_rate() {
        let mut seen = Vec::new();
        read_lines("x\n".repeat(100_000).as_bytes(), |line| seen.push(line));
        // Reading takes a few seconds at most, each with `LINES_PER_SECOND`.
        assert!(seen.len() < 20_000, "{}", seen.len());
        assert!(seen.last().unwrap().contains("more lines in that second were dropped"));
    }
}
