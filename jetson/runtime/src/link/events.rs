//! What the link reports, and the sentences for refusals.

use std::borrow::Cow;

use vizflyt_protocol::mavlink::SigningFault;

use super::fence::FenceEvent;
use super::identity::Firmware;
use super::navigation::Delay;
use super::params::ParamEvent;
use super::rates::Rate;

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
    /// The autopilot reported its firmware.
    Firmware(Firmware),
    /// Motors may turn.
    Armed,
    /// Motors are off.
    Disarmed,
    /// The autopilot has accepted the take-off.
    TakingOff,
    /// The mode changed to this number (ArduCopter's), by us or by someone else.
    Mode(u32),
    /// The autopilot refuses a command that the goal needs; why, in a sentence.
    Refused(String),
    /// A text of the autopilot.
    Text {
        /// 0 (emergency) to 7 (debug), as in syslog.
        severity: u8,
        /// The text.
        text: String,
    },
    /// A stream comes too seldom, and asking again did not help.
    Slow(Rate),
    /// External navigation is later than the autopilot's setting.
    Delay(Delay),
    /// Packets are refused for their signature.
    NotSigned {
        /// What is wrong with it.
        fault: SigningFault,
        /// Packets refused for that since the start.
        count: u64,
    },
    /// The result of a fence upload.
    Fence(FenceEvent),
    /// The result of reading or writing parameters.
    Param(ParamEvent),
}

impl LinkEvent {
    /// Returns a sentence for people about what they should look into; `None` for what needs nobody.
    pub fn warning(&self) -> Option<String> {
        match self {
            Self::Slow(rate) => Some(format!(
                "the autopilot sends message {} at {:.0} Hz, not at the {:.0} asked for; the link may be \
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
                 parameters, and guard and referee keep the rest"
            )),
            _ => None,
        }
    }
}

/// Returns the sentence for a command that was given up; `guess` is a cause that the autopilot did
/// not name.
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

/// Returns what to do about a text of ArduCopter's or PX4's, where we know (AP_Arming.cpp,
/// HealthAndArmingChecks, and seen on 4.8.0-dev).
pub fn advice(text: &str) -> Option<&'static str> {
    let text = text.to_ascii_lowercase();
    ADVICE.iter().find(|(key, _)| text.contains(key)).map(|&(_, advice)| advice)
}

/// What a text contains, and what to do; the first that fits counts.
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
