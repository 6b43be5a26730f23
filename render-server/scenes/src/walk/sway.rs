//! Motion of a phone in the hand of a walking person: steps, slow drift and tremor, all as sums of sines.

use core::f64::consts::TAU;

use crate::random::Rng;

/// Sway of a walk.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Sway {
    height_m: Vec<Wave>,
    aside_m: Vec<Wave>,
    yaw_rad: Vec<Wave>,
    pitch_rad: Vec<Wave>,
    roll_rad: Vec<Wave>,
}

/// Sway at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Swayed {
    /// Height of the camera above the floor. [m]
    pub(super) height_m: f64,
    /// Offset to the left of the path. [m]
    pub(super) aside_m: f64,
    pub(super) yaw_rad: f64,
    /// Pitch, upwards.
    pub(super) pitch_rad: f64,
    pub(super) roll_rad: f64,
}

/// Sine with an integer number of periods in the walk.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Wave {
    amplitude: f64,
    periods: f64,
    phase: f64,
}

impl Sway {
    /// Draws the sway of a walk of this duration.
    ///
    /// A walking person takes about two steps per second: the body rises at 2 Hz and leans at 1 Hz, by some
    /// centimetres. A hand that holds an object drifts slowly by one or two degrees, and has a tremor of about 0.1
    /// degrees at 4 to 10 Hz (Elble and Koller, Tremor, 1990).
    pub(super) fn draw(rng: &mut Rng, seconds: f64) -> Self {
        let cadence_hz = rng.range(1.7, 1.95);
        let mut wave = |amplitude: f64, hz: f64| Wave {
            amplitude,
            periods: libm::round(hz * seconds).max(1.0),
            phase: rng.unit(),
        };
        let degrees = 1f64.to_radians();
        let once = 1.0 / seconds;
        Self {
            // Higher on one half of the path than on the other.
            height_m: vec![wave(0.14, once), wave(0.012, cadence_hz)],
            aside_m: vec![wave(0.018, cadence_hz / 2.0), wave(0.02, 0.23)],
            yaw_rad: vec![
                wave(2.0 * degrees, 0.31),
                wave(0.6 * degrees, cadence_hz / 2.0),
                wave(0.06 * degrees, 5.3),
                wave(0.03 * degrees, 8.1),
            ],
            pitch_rad: vec![
                wave(6.0 * degrees, 3.0 * once),
                wave(1.2 * degrees, 0.37),
                wave(0.5 * degrees, cadence_hz),
                wave(0.06 * degrees, 6.1),
                wave(0.03 * degrees, 9.2),
            ],
            roll_rad: vec![
                wave(1.5 * degrees, 0.19),
                wave(0.5 * degrees, cadence_hz / 2.0),
                wave(0.05 * degrees, 7.0),
            ],
        }
    }

    /// Returns the sway at a share of the walk.
    pub(super) fn at(&self, turn: f64) -> Swayed {
        let sum = |waves: &[Wave]| -> f64 {
            let at =
                |wave: &Wave| wave.amplitude * libm::sin(TAU * (wave.periods * turn + wave.phase));
            waves.iter().map(at).sum()
        };
        Swayed {
            height_m: EYE_M + sum(&self.height_m),
            aside_m: sum(&self.aside_m),
            yaw_rad: sum(&self.yaw_rad),
            pitch_rad: PITCH_RAD + sum(&self.pitch_rad),
            roll_rad: sum(&self.roll_rad),
        }
    }
}

/// Height of a phone that is held in front of the chest. [m]
const EYE_M: f64 = 1.42;
/// Mean pitch, slightly downwards, so that images show the floor, which defines the vertical axis. [rad]
const PITCH_RAD: f64 = -0.09;
