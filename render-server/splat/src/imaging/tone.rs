//! Conversion between display colours and linear light by tables (sRGB, IEC 61966-2-1).

/// Tables of both directions.
#[derive(Debug)]
pub struct Tone {
    /// Linear light of the display colour `n / LINEAR`.
    linear: Vec<f32>,
    /// Display colour of the linear light `n / SHOWN`.
    shown: Vec<u8>,
}

impl Default for Tone {
    fn default() -> Self {
        let linear = (0..=LINEAR + 1).map(|n| linear_from_display(n as f64 / LINEAR as f64) as f32);
        let shown = (0..=SHOWN).map(|n| {
            let shown = display_from_linear(n as f64 / SHOWN as f64);
            (255.0 * shown + 0.5) as u8
        });
        Self { linear: linear.collect(), shown: shown.collect() }
    }
}

impl Tone {
    /// Returns the linear light of a display colour, clamped to 0 to 1.
    #[expect(clippy::manual_clamp, reason = "NaN becomes 0")]
    #[inline]
    pub fn linear(&self, shown: f32) -> f32 {
        let at = shown.max(0.0).min(1.0) * LINEAR as f32;
        let n = at as usize;
        let (low, high) = (self.linear[n], self.linear[n + 1]);
        low + (high - low) * (at - n as f32)
    }

    /// Returns the display colour of linear light, clamped to 0 to 1 like a full sensor.
    #[expect(clippy::manual_clamp, reason = "NaN becomes 0")]
    #[inline]
    pub fn shown(&self, linear: f32) -> u8 {
        self.shown[(linear.max(0.0).min(1.0) * SHOWN as f32 + 0.5) as usize]
    }
}

/// Returns the luminance of linear red, green, blue (ITU-R BT.709).
#[inline]
pub fn luminance(red: f32, green: f32, blue: f32) -> f32 {
    0.2126 * red + 0.7152 * green + 0.0722 * blue
}

fn linear_from_display(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { libm::pow((v + 0.055) / 1.055, 2.4) }
}

fn display_from_linear(v: f64) -> f64 {
    if v <= 0.0031308 { 12.92 * v } else { 1.055 * libm::pow(v, 1.0 / 2.4) - 0.055 }
}

const LINEAR: usize = 4096;
/// In the dark, a step of a display colour is 1 / (12.92 * 255) of linear light: about five entries.
const SHOWN: usize = 16384;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn display_colours_survive_a_round_trip() {
        let tone = Tone::default();
        for byte in 0..=255u8 {
            assert_eq!(tone.shown(tone.linear(f32::from(byte) / 255.0)), byte);
        }
        assert_eq!((tone.linear(-1.0), tone.linear(f32::NAN)), (0.0, 0.0));
        assert!((tone.linear(7.0) - 1.0).abs() < 1e-6);
        assert_eq!((tone.shown(9.0), tone.shown(f32::NAN)), (255, 0));
    }
}
