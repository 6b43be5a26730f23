//! What the link reports, and refusals in words.

/// Something that happened on the link.
#[derive(Clone, Debug, PartialEq)]
pub enum LinkEvent {
    /// Heartbeats of an autopilot began to come.
    Connected {
        /// Its system id.
        system: u8,
    },
    /// No heartbeat for 3 s.
    Lost,
    /// The autopilot restarted.
    Rebooted,
    /// Motors may turn.
    Armed,
    /// Motors are off.
    Disarmed,
    /// The autopilot has accepted the take-off.
    TakingOff,
    /// The mode changed to this number, by us or by someone else.
    Mode(u32),
    /// The autopilot will not do what the goal needs; why, in words.
    Refused(String),
    /// A text of the autopilot.
    Text {
        /// 0 (emergency) to 7 (debug), as in syslog.
        severity: u8,
        /// The text.
        text: String,
    },
}

/// Returns the sentence for a command that was given up.
pub(super) fn refusal(command: &str, why: &str, said: &[&str]) -> String {
    let mut text = format!("{command} {why}");
    if !said.is_empty() {
        text = format!("{text}; the autopilot says \"{}\"", said.join("\", \""));
    }
    if let Some(advice) = said.iter().rev().find_map(|said| advice(said)) {
        text = format!("{text}; {advice}");
    }
    text
}

/// Returns what to do about a text of ArduCopter's, where we know (AP_Arming.cpp, and seen on
/// 4.8.0-dev).
pub fn advice(text: &str) -> Option<&'static str> {
    const ADVICE: [(&str, &str); 9] = [
        ("rc not found", "connect a receiver, or set FS_THR_ENABLE=0 to fly without one"),
        ("origin", "the origin is not set: the link must reach the autopilot before take-off"),
        ("visodom", "no external navigation arrives: check that the server has poses"),
        ("viso", "no external navigation arrives: check that the server has poses"),
        (
            "need position estimate",
            "external navigation has not converged: VISO_TYPE=1, EK3_SRC1_* = 6",
        ),
        ("compass", "set COMPASS_ENABLE=0 and EK3_SRC1_YAW=6, or calibrate it"),
        ("batt", "charge or change the battery"),
        ("accel", "calibrate or level the vehicle, and keep it still"),
        ("gyro", "keep the vehicle still while it starts"),
    ];
    let text = text.to_ascii_lowercase();
    ADVICE.iter().find(|(key, _)| text.contains(key)).map(|&(_, advice)| advice)
}
