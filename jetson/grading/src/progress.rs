//! Progress of a grade: on a terminal one line that is updated, otherwise one line per flight.

use std::io::{IsTerminal, Write};
use std::time::Instant;

use vizflyt_protocol::messages::OutcomeKind;

use super::document::Run;

/// Width of the bar. [characters]
const BAR: usize = 24;

/// Progress output on standard error; standard output is for the result.
pub(super) struct Progress {
    all: usize,
    done: usize,
    finished: usize,
    /// Virtual time of all finished flights. [s]
    virtual_s: f64,
    started: Instant,
    is_terminal: bool,
}

impl Progress {
    pub(super) fn new(all: usize) -> Self {
        Self {
            all,
            done: 0,
            finished: 0,
            virtual_s: 0.0,
            started: Instant::now(),
            is_terminal: std::io::stderr().is_terminal(),
        }
    }

    /// Counts a finished flight and updates the output.
    pub(super) fn flown(&mut self, run: &Run, virtual_s: f64) {
        self.done += 1;
        self.finished += usize::from(run.outcome == OutcomeKind::Finished);
        self.virtual_s += virtual_s;
        let mut out = std::io::stderr().lock();
        // Write errors are ignored: the terminal may be closed, and the grade continues.
        let _ = if self.is_terminal {
            if run.outcome != OutcomeKind::Finished {
                let _ = writeln!(out, "\r\x1b[K{}", line(run));
            }
            write!(out, "\r\x1b[K{}", self.bar())
        } else {
            writeln!(out, "{}/{} {}", self.done, self.all, line(run))
        };
        let _ = out.flush();
    }

    /// Ends the line with the simulation speed.
    pub(super) fn end(&self) {
        let mut out = std::io::stderr().lock();
        let clear = if self.is_terminal { "\r\x1b[K" } else { "" };
        let wall_s = self.started.elapsed().as_secs_f64();
        let _ = writeln!(
            out,
            "{clear}{} flights, {:.0} s of virtual time in {wall_s:.0} s: {:.1} x real time",
            self.done,
            self.virtual_s,
            self.virtual_s / wall_s.max(1e-3)
        );
    }

    fn bar(&self) -> String {
        let full = (BAR * self.done).checked_div(self.all).unwrap_or(BAR);
        let wall_s = self.started.elapsed().as_secs_f64();
        let left_s = wall_s / self.done.max(1) as f64 * (self.all - self.done) as f64;
        format!(
            "[{}{}] {}/{}, {} finished, {:.1} x real time, {left_s:.0} s left",
            "#".repeat(full),
            ".".repeat(BAR - full),
            self.done,
            self.all,
            self.finished,
            self.virtual_s / wall_s.max(1e-3)
        )
    }
}

/// Returns the result of a flight as one line.
fn line(run: &Run) -> String {
    let why = run.cause.as_deref().unwrap_or(&run.reason);
    format!(
        "seed {} {}: {}, {} of {} stages, {:.1} s: {why}",
        run.seed,
        run.variant,
        run.outcome,
        run.stages_passed,
        run.stages.len(),
        run.seconds
    )
}
