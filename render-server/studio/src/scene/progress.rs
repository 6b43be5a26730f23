//! Progress and remaining time on standard error: one line that is updated on a terminal, otherwise a line every 30 s.

use std::io::{IsTerminal, Write};
use std::time::{Duration, Instant};

/// Progress of a job.
#[derive(Debug)]
pub(super) struct Progress {
    title: String,
    start: Instant,
    next: Duration,
}

impl Progress {
    /// Starts now. Every line begins with the title.
    pub(super) fn new(title: impl Into<String>) -> Self {
        Self { title: title.into(), start: Instant::now(), next: Duration::ZERO }
    }

    /// Shows the progress and the estimated remaining time; `share` is from 0 to 1.
    pub(super) fn show(&mut self, share: f64, what: impl FnOnce() -> String) {
        let elapsed = self.start.elapsed();
        if elapsed < self.next {
            return;
        }
        let mut stderr = std::io::stderr();
        let watched = stderr.is_terminal();
        self.next = elapsed + Duration::from_millis(if watched { 250 } else { 30_000 });
        let line = format!("{}{}{}", self.title, what(), left(elapsed, share));
        // A closed terminal must not stop the job.
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

/// Returns the text of the estimated remaining time; empty as long as it cannot be estimated.
fn left(elapsed: Duration, share: f64) -> String {
    if !(share > 0.0 && share <= 1.0) || elapsed < SOON {
        return String::new();
    }
    let left_s = (elapsed.as_secs_f64() / share * (1.0 - share)).ceil() as u64;
    format!(", {}:{:02} left", left_s / 60, left_s % 60)
}

/// Minimum elapsed time for an estimate.
const SOON: Duration = Duration::from_millis(500);

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn extrapolates_the_remaining_time() {
        let ten = Duration::from_secs(10);
        assert_eq!(left(ten, 0.1), ", 1:30 left");
        assert_eq!(left(ten, 1.0), ", 0:00 left");
        for share in [0.0, f64::NAN, 1.5, -1.0] {
            assert_eq!(left(ten, share), "");
        }
        assert_eq!(left(Duration::from_millis(3), 0.5), "");
    }
}
