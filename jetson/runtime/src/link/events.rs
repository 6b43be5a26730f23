//! Events of the link, and messages for rejected commands.

use std::borrow::Cow;

use vizflyt_protocol::mavlink::SigningFault;

use super::fence::FenceEvent;
use super::identity::Firmware;
use super::navigation::Delay;
use super::params::ParamEvent;
use super::rates::Rate;

/// Event on the link.
#[derive(Clone, Debug, PartialEq)]
pub enum LinkEvent {
    /// Heartbeats of an autopilot are received.
    Connected {
        /// System id of the autopilot.
        system: u8,
    },
    /// Another sender of heartbeats appeared: what it is, as a sentence.
    Neighbor(String),
    /// No packet of the autopilot for 3 s.
    Lost,
    /// The autopilot restarted.
    Rebooted,
    /// The autopilot reported its firmware.
    Firmware(Firmware),
    /// The motors may turn.
    Armed,
    /// The motors are off.
    Disarmed,
    /// The autopilot has accepted the take-off.
    TakingOff,
    /// The mode changed to this number (ArduCopter's), by us or by another party.
    Mode(u32),
    /// The autopilot rejects a command that the goal needs; the reason as a sentence.
    Refused(String),
    /// Text message of the autopilot.
    Text {
        /// Severity from 0 (emergency) to 7 (debug), as in syslog.
        severity: u8,
        text: String,
    },
    /// The rate of a stream is too low, even after repeated requests.
    Slow(Rate),
    /// The latency of external navigation exceeds the autopilot's setting.
    Delay(Delay),
    /// Packets are rejected for their signature.
    NotSigned {
        /// Fault of the signature.
        fault: SigningFault,
        /// Packets rejected for this fault since the start.
        count: u64,
    },
    /// Result of a fence upload.
    Fence(FenceEvent),
    /// Result of reading or writing parameters.
    Param(ParamEvent),
}

impl LinkEvent {
    /// Returns a warning for the user; `None` if no action is needed.
    pub fn warning(&self) -> Option<String> {
        match self {
            Self::Slow(rate) => Some(format!(
                "the autopilot sends message {} at {:.0} Hz, {:.0} Hz requested; the link may be \
                 too slow: raise SERIALn_BAUD, or lower the rates of a ground station",
                rate.id, rate.achieved_hz, rate.asked_hz
            )),
            Self::Delay(Delay { parameter, measured_ms, set_ms: Some(set_ms) }) => Some(format!(
                "external navigation reaches the autopilot {measured_ms:.0} ms after its measurement, and \
                 {parameter} is {set_ms:.0}; set {parameter}={measured_ms:.0}"
            )),
            Self::NotSigned { fault, count } => Some(format!(
                "packets on the link are refused ({count} so far): {fault}; see `vizflyt vehicle sign`"
            )),
            Self::Fence(FenceEvent::Rejected(why)) => Some(format!(
                "the autopilot's own fence is not the arena's: {why}; it flies within its FENCE_* \
                 parameters, and guard and referee check the rest"
            )),
            _ => None,
        }
    }
}

/// Returns the message for a command that was given up; `guess` is a cause that the autopilot did not report.
pub(super) fn refusal(
    command: &str,
    why: &str,
    texts: &[&str],
    guess: Option<Cow<'static, str>>,
) -> String {
    let mut text = format!("{command} {why}");
    if let Some(guess) = guess {
        text = format!("{text}: {guess}");
    }
    if !texts.is_empty() {
        text = format!("{text}; the autopilot says \"{}\"", texts.join("\", \""));
    }
    if let Some(advice) = texts.iter().rev().find_map(|text| advice(text)) {
        text = format!("{text}; {advice}");
    }
    text
}

/// Returns advice for a text of ArduCopter or PX4, if known (AP_Arming.cpp, HealthAndArmingChecks, and observed on
/// 4.8.0-dev).
pub fn advice(text: &str) -> Option<&'static str> {
    let text = text.to_ascii_lowercase();
    ADVICE.iter().find(|(key, _)| text.contains(key)).map(|&(_, advice)| advice)
}

/// Search text and advice; the first match counts.
const ADVICE: [(&str, &str); 31] = [
    ("rc not found", "connect a receiver, or set FS_THR_ENABLE=0 to fly without one"),
    ("throttle below failsafe", "switch the transmitter on, and set FS_THR_VALUE below its lowest"),
    ("throttle too high", "pull the throttle stick down"),
    ("rc not calibrated", "calibrate the transmitter"),
    ("radio failsafe", "switch the transmitter on"),
    (
        "manual control lost",
        "switch the transmitter on, or set COM_RC_IN_MODE=4 to fly without one",
    ),
    ("no ekf origin", "the origin is not set: the link must reach the autopilot before take-off"),
    ("origin", "the origin is not set: the link must reach the autopilot before take-off"),
    ("requires position", "external navigation has not converged: VISO_TYPE=1, EK3_SRC1_* = 6"),
    (
        "need position estimate",
        "external navigation has not converged: VISO_TYPE=1, EK3_SRC1_* = 6",
    ),
    ("no offboard signal", "setpoints must come at more than 2 Hz before OFFBOARD"),
    ("visodom", "no external navigation arrives: check that the server has poses"),
    ("viso", "no external navigation arrives: check that the server has poses"),
    ("ekf attitude is bad", "keep the vehicle still and level until the estimator settles"),
    ("ekf", "keep the vehicle still until the estimator settles; check external navigation"),
    ("ahrs", "keep the vehicle still until the estimator settles"),
    ("gps", "set GPS1_TYPE=0 (GPS_TYPE before 4.6) and EK3_SRC1_* = 6: there is no GPS in a room"),
    ("compass", "set COMPASS_ENABLE=0 and EK3_SRC1_YAW=6, or calibrate it"),
    ("yaw", "set EK3_SRC1_YAW=6: external navigation gives the heading"),
    ("batt", "charge or change the battery"),
    ("voltage", "charge or change the battery; check the power module"),
    ("accel", "calibrate or level the vehicle, and keep it still"),
    ("gyro", "keep the vehicle still while it starts"),
    ("leaning", "put the vehicle on level ground"),
    ("baro", "let the barometer settle; shield it from wind and light"),
    ("fence", "the fence needs a position, or FENCE_* contradict each other"),
    ("safety switch", "press the safety switch, or set BRD_SAFETY_DEFLT=0"),
    ("mode not armable", "the mode before GUIDED forbids arming; try again"),
    ("not armable", "leave LAND or RTL first"),
    ("logging", "put in an SD card, or set LOG_BACKEND_TYPE=0"),
    ("motors", "check FRAME_CLASS, FRAME_TYPE and the motors' emergency stop switch"),
];
