//! What is done and how long the rest takes, on standard error: a line that changes where people watch, else one every
//! half minute.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// The progress of one piece of work.
#[derive(Debug)]
pub(super) struct Progress {
    title: String,
    start: Instant,
    next: Duration,
}

impl Progress {
    /// Begins now; every line begins with the title.
    pub(super) fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), start: Instant::now(), next: Duration::ZERO }
    }

    /// Shows what is done, and how long the rest takes if it goes on like this; `share` is of 1.
    pub(super) fn show(&mut self, share: f64, what: impl FnOnce() -> String) {
        let elapsed = self.start.elapsed();
        if elapsed < self.next {
            return;
        }
        let mut stderr = std::io::stderr();
        let watched = stderr.is_terminal();
        self.next = elapsed + Duration::from_millis(if watched { 250 } else { 30_000 });
        let line = format!("{}{}{}", self.title, what(), left(elapsed, share));
        // A terminal that is gone is no reason to stop.
        let _ = if watched {
            write!(stderr, "\r{line:<78}").and_then(|()| stderr.flush())
        } else {
            writeln!(stderr, "{line}")
        };
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        let mut stderr = std::io::stderr();
        if stderr.is_terminal() {
            let _ = write!(stderr, "\r{:<78}\r", "").and_then(|()| stderr.flush());
        }
    }
}

/// Returns how long the rest takes, in words; nothing before that can be known.
fn left(elapsed: Duration, share: f64) -> String {
    if !(share > 0.0 && share <= 1.0) || elapsed < SOON {
        return String::new();
    }
    let left_s = (elapsed.as_secs_f64() / share * (1.0 - share)).ceil() as u64;
    format!(", {}:{:02} left", left_s / 60, left_s % 60)
}

/// What took less time says nothing of the rest.
const SOON: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_rest_takes_as_long_as_what_was() {
        let ten = Duration::from_secs(10);
        assert_eq!(left(ten, 0.1), ", 1:30 left");
        assert_eq!(left(ten, 1.0), ", 0:00 left");
        for share in [0.0, f64::NAN, 1.5, -1.0] {
            assert_eq!(left(ten, share), "");
        }
        assert_eq!(left(Duration::from_millis(3), 0.5), "");
    }
}
