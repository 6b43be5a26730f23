//! Terminal output of a flight: events as lines, and below them one status line that is updated. Without a
//! terminal, plain lines: each event, and periodically the status.
//!
//! [`Console`] has no side effects: it returns the text. [`Screen`] writes it.

use std::io::IsTerminal;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use vizflyt_process::{OutputStream, print_text};
use vizflyt_protocol::messages::{FlightPhase, Telemetry};

/// Content of the status line.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Status {
    pub phase: FlightPhase,
    /// Battery charge, 0 to 1; `None` if unknown.
    pub battery_fraction: Option<f32>,
    /// Rate of images delivered to the plugin. [Hz]
    pub image_hz: f32,
    /// Pose stamp to plugin callback, median of the last second. [ms]
    pub age_ms: f32,
    /// Time inside the plugin's `on_image`, median of the last second. [ms]
    pub plugin_ms: f32,
}

impl Status {
    /// Returns the status of a telemetry report.
    pub fn of(telemetry: &Telemetry) -> Self {
        let battery = telemetry.vehicle.battery_fraction;
        Self {
            phase: telemetry.phase,
            battery_fraction: (battery >= 0.0).then_some(battery),
            image_hz: telemetry.images.rate_hz,
            age_ms: telemetry.images.age_ms_p50,
            plugin_ms: telemetry.images.plugin_ms_p50,
        }
    }

    /// Returns the status as one line.
    pub fn line(&self) -> String {
        let battery = match self.battery_fraction {
            Some(fraction) => format!("{:3.0} %", 100.0 * fraction),
            None => "  ? %".to_owned(),
        };
        format!(
            "{phase:<10}  battery {battery}  images {hz:5.1} Hz  age {age:5.1} ms  \
             plugin {plugin:5.1} ms",
            phase = phase_name(self.phase),
            hz = self.image_hz,
            age = self.age_ms,
            plugin = self.plugin_ms,
        )
    }
}

pub fn phase_name(phase: FlightPhase) -> &'static str {
    match phase {
        FlightPhase::Connecting => "connecting",
        FlightPhase::Preparing => "preparing",
        FlightPhase::TakingOff => "taking off",
        FlightPhase::Flying => "flying",
        FlightPhase::Holding => "holding",
        FlightPhase::Landing => "landing",
        FlightPhase::Landed => "landed",
        FlightPhase::Waiting => "waiting",
    }
}

/// Kind of output.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Medium {
    /// A terminal with escape sequences.
    Terminal,
    /// A file or a pipe.
    Plain,
}

/// Minimum period of plain status lines. [s]
const PLAIN_EVERY_S: f64 = 5.0;
/// Escape sequence: to column 0, and clear the line.
const CLEAR: &str = "\r\x1b[2K";
/// Escape sequence: cut long lines instead of wrapping them, because a wrapped line could not be cleared.
const WRAP_OFF: &str = "\x1b[?7l";
/// Escape sequence: wrap long lines again.
const WRAP_ON: &str = "\x1b[?7h";

/// State of the output.
#[derive(Debug)]
pub struct Console {
    medium: Medium,
    status: Option<Status>,
    last_event: String,
    told_at_s: Option<f64>,
}

impl Console {
    pub fn new(medium: Medium) -> Self {
        Self { medium, status: None, last_event: String::new(), told_at_s: None }
    }

    /// Returns the output for a permanent line.
    pub fn line(&mut self, text: &str) -> String {
        let text = printable(text);
        let status = self.status_line();
        match self.medium {
            Medium::Terminal if self.status.is_some() => format!("{CLEAR}{text}\n{status}"),
            _ => text + "\n",
        }
    }

    /// Returns the output for an event of the flight; the status line repeats the last event.
    pub fn event(&mut self, text: &str) -> String {
        self.last_event = printable(text.trim());
        self.line(text)
    }

    /// Returns the output for a new status at `now_s`.
    pub fn status(&mut self, now_s: f64, status: &Status) -> String {
        let former = self.status.replace(status.clone());
        match self.medium {
            Medium::Terminal => format!("{CLEAR}{}", self.status_line()),
            Medium::Plain => {
                let changed = former.is_none_or(|former| former.phase != status.phase);
                let due = self.told_at_s.is_none_or(|at_s| now_s - at_s >= PLAIN_EVERY_S);
                if !(changed || due) {
                    return String::new();
                }
                self.told_at_s = Some(now_s);
                format!("{}\n", status.line())
            }
        }
    }

    /// Returns the output for the end of the flight, which removes the status line.
    pub fn end(&mut self) -> String {
        match (self.medium, self.status.take()) {
            (Medium::Terminal, Some(_)) => CLEAR.to_owned(),
            _ => String::new(),
        }
    }

    fn status_line(&self) -> String {
        let Some(status) = &self.status else { return String::new() };
        // Leaves the cursor at the start, so that other output begins there.
        format!("{WRAP_OFF}{}  | {}{WRAP_ON}\r", status.line(), self.last_event)
    }
}

/// Replaces control characters, so that a plugin cannot move the cursor or set the terminal's title. The ends of lines
/// become spaces.
pub fn printable(text: &str) -> String {
    let shown = |c: char| match c {
        '\t' => c,
        '\n' => ' ',
        _ if c.is_control() => '\u{fffd}',
        _ => c,
    };
    text.chars().map(shown).collect()
}

/// A [`Console`] on standard output.
#[derive(Debug)]
pub struct Screen {
    console: Console,
    start: Instant,
}

impl Default for Screen {
    fn default() -> Self {
        let is_terminal =
            std::io::stdout().is_terminal() && std::env::var_os("TERM").is_none_or(|t| t != "dumb");
        let medium = if is_terminal { Medium::Terminal } else { Medium::Plain };
        Self { console: Console::new(medium), start: Instant::now() }
    }
}

impl Screen {
    /// Prints a permanent line.
    pub fn line(&mut self, text: &str) {
        let text = self.console.line(text);
        write(&text);
    }

    /// Prints an event of the flight.
    pub fn event(&mut self, text: &str) {
        let text = self.console.event(text);
        write(&text);
    }

    /// Shows a new status.
    pub fn status(&mut self, status: &Status) {
        let text = self.console.status(self.start.elapsed().as_secs_f64(), status);
        write(&text);
    }

    /// Removes the status line.
    pub fn end(&mut self) {
        let text = self.console.end();
        write(&text);
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.end();
    }
}

fn write(text: &str) {
    if text.is_empty() {
        return;
    }
    print_text(OutputStream::Out, text.as_bytes());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flying() -> Status {
        Status {
            phase: FlightPhase::Flying,
            battery_fraction: Some(0.87),
            image_hz: 59.9,
            age_ms: 12.34,
            plugin_ms: 1.04,
        }
    }

    const LINE: &str = "flying      battery  87 %  images  59.9 Hz  age  12.3 ms  plugin   1.0 ms";

    #[test]
    fn keeps_the_status_line_below_events_in_a_terminal() {
        let mut console = Console::new(Medium::Terminal);
        assert_eq!(console.event("taking off"), "taking off\n");
        let shown = format!("\x1b[?7l{LINE}  | taking off\x1b[?7h\r");
        assert_eq!(console.status(0.0, &flying()), format!("\r\x1b[2K{shown}"));
        let shown = format!("\x1b[?7l{LINE}  | the plugin flies\x1b[?7h\r");
        let expected = format!("\r\x1b[2K  the plugin flies\n{shown}");
        assert_eq!(console.event("  the plugin flies"), expected);
        assert_eq!(console.end(), "\r\x1b[2K");
        assert_eq!(console.end(), "", "once");
    }

    #[test]
    fn replaces_control_characters() {
        assert_eq!(printable("a\x1b[31mb\nc\td"), "a\u{fffd}[31mb c\td");
    }

    #[test]
    fn prints_only_lines_without_a_terminal() {
        let mut console = Console::new(Medium::Plain);
        assert_eq!(console.status(0.0, &flying()), format!("{LINE}\n"));
        assert_eq!(console.status(0.5, &flying()), "", "nothing new");
        let holding = Status { phase: FlightPhase::Holding, ..flying() };
        assert!(console.status(0.6, &holding).starts_with("holding"), "at once");
        assert_eq!(console.status(5.5, &holding), "");
        assert!(console.status(5.6, &holding).starts_with("holding"), "every five seconds");
        assert_eq!(console.event("held"), "held\n");
        assert_eq!(console.end(), "");
    }

    #[test]
    fn replaces_control_characters_of_a_plugin() {
        let mut console = Console::new(Medium::Plain);
        assert_eq!(console.line("\x1b[2Jgone\r\u{7}"), "\u{fffd}[2Jgone\u{fffd}\u{fffd}\n");
    }

    #[test]
    fn shows_an_unknown_battery_as_unknown() {
        let telemetry = Telemetry {
            vehicle: vizflyt_protocol::messages::VehicleState {
                battery_fraction: -1.0,
                ..Default::default()
            },
            ..Default::default()
        };
        let status = Status::of(&telemetry);
        assert_eq!(status.battery_fraction, None);
        assert!(status.line().contains("battery   ? %"), "{}", status.line());
    }
}
