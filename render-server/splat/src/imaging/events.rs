//! Event camera: each pixel reports changes of its brightness by a given share.
//!
//! The model is that of ESIM (H. Rebecq, D. Gehrig, D. Scaramuzza, CoRL 2018). A pixel stores the logarithm of the
//! intensity of its last event. Between two images the logarithm is assumed to be linear in time. Each time it
//! differs from the stored value by a contrast threshold, an event with time and sign is emitted, and the stored
//! value moves by the threshold. A dead time drops events that follow the pixel's last event too closely. The
//! intensity is linear luminance plus a small constant, so that black has a logarithm.
//!
//! A high image rate improves the result: movement by more than a pixel between two images produces no events on the
//! way.

use super::tone;
use super::tone::luminance;
use crate::RgbdImage;

/// Parameters of an event camera.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EventSensor {
    /// Contrast threshold for increasing brightness, in the natural logarithm: 0.2 is 22 % brighter.
    pub threshold_on: f32,
    /// Contrast threshold for decreasing brightness.
    pub threshold_off: f32,
    /// Dead time of a pixel after an event. [ns]
    pub dead_ns: u64,
    /// Linear luminance that is added to every pixel.
    pub dark: f32,
}

impl Default for EventSensor {
    /// Thresholds of 20 %; a DVS240 has 15 to 50 (P. Lichtsteiner, C. Posch, T. Delbruck, IEEE JSSC 43, 2008: 15 %).
    /// No dead time.
    fn default() -> Self {
        Self { threshold_on: 0.2, threshold_off: 0.2, dead_ns: 0, dark: 0.001 }
    }
}

/// Brightness change of one pixel.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Event {
    /// Time of the event. [ns]
    pub t_ns: u64,
    /// Row.
    pub y: u16,
    /// Column.
    pub x: u16,
    /// Whether the brightness increased.
    pub on: bool,
}

/// State of the pixels of an event camera.
#[derive(Clone, Debug, Default)]
pub struct EventCamera {
    size: (u32, u32),
    last_ns: u64,
    pixels: Vec<PixelState>,
}

#[derive(Clone, Copy, Debug)]
struct PixelState {
    /// Logarithm in the last image.
    last: f32,
    /// Logarithm at the last event.
    kept: f32,
    /// End of the dead time. [ns]
    silent_until_ns: u64,
}

impl EventCamera {
    /// Processes the image of an instant, and appends the events since the last one to `events`, ordered by time,
    /// then row, then column. The first image, one of another size, and one that is not later than the last reset the
    /// state and produce no events.
    pub fn push(
        &mut self,
        sensor: &EventSensor,
        image: &RgbdImage,
        at_ns: u64,
        events: &mut Vec<Event>,
    ) {
        let size = (image.width_px, image.height_px);
        let tone = tone();
        let log = |rgb: &[f32]| {
            let [red, green, blue] = [0, 1, 2].map(|c| tone.linear(rgb[c]));
            libm::logf(luminance(red, green, blue) + sensor.dark)
        };
        if self.size != size || at_ns <= self.last_ns || self.pixels.is_empty() {
            self.pixels.clear();
            self.pixels.extend(image.rgb.chunks_exact(3).map(|rgb| {
                let log = log(rgb);
                PixelState { last: log, kept: log, silent_until_ns: 0 }
            }));
            (self.size, self.last_ns) = (size, at_ns);
            return;
        }
        let from = events.len();
        let span_ns = at_ns - self.last_ns;
        let width = image.width_px as usize;
        for (n, (pixel, rgb)) in self.pixels.iter_mut().zip(image.rgb.chunks_exact(3)).enumerate() {
            let now = log(rgb);
            let (x, y) = ((n % width) as u16, (n / width) as u16);
            pixel.cross(sensor, now, self.last_ns, span_ns, |t_ns, on| {
                events.push(Event { t_ns, y, x, on });
            });
        }
        events[from..].sort_unstable();
        self.last_ns = at_ns;
    }
}

impl PixelState {
    /// Emits the events of one pixel until its logarithm is `now`.
    fn cross(
        &mut self,
        sensor: &EventSensor,
        now: f32,
        last_ns: u64,
        span_ns: u64,
        mut event: impl FnMut(u64, bool),
    ) {
        let on = now > self.last;
        let step = if on { sensor.threshold_on } else { -sensor.threshold_off };
        let slope = f64::from(now) - f64::from(self.last);
        // Computed from the stored value, so that rounding errors do not accumulate. The number of iterations is
        // bounded, because it could be infinite.
        for _ in 0..MOST_EVENTS {
            let next = self.kept + step;
            let is_reached = if on { next <= now } else { next >= now };
            if !is_reached || slope == 0.0 || next == self.kept {
                break;
            }
            self.kept = next;
            let share = ((f64::from(next) - f64::from(self.last)) / slope).clamp(0.0, 1.0);
            let t_ns = last_ns + (share * span_ns as f64).round() as u64;
            if t_ns >= self.silent_until_ns {
                event(t_ns, on);
                self.silent_until_ns = t_ns.saturating_add(sensor.dead_ns);
            }
        }
        self.last = now;
    }
}

/// Maximum number of events of a pixel between two images; black to white with a threshold of 1 % gives 700.
const MOST_EVENTS: usize = 4096;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::imaging::tone::Tone;

    const SENSOR: EventSensor =
        EventSensor { threshold_on: 0.2, threshold_off: 0.3, dead_ns: 0, dark: 0.0 };

    /// Returns a uniform grey image whose linear luminance is as close to `light` as display colours allow, and that
    /// luminance.
    fn grey(light: f64) -> (RgbdImage, f64) {
        // Inverse of the tone curve by bisection.
        let tone = Tone::default();
        let (mut low, mut high) = (0f32, 1f32);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if f64::from(tone.linear(middle)) < light { low = middle } else { high = middle }
        }
        let mut image = RgbdImage::default();
        image.resize(3, 2);
        image.rgb.fill(low);
        (image, f64::from(tone.linear(low)))
    }

    fn events(sensor: &EventSensor, lights: &[(f64, u64)]) -> Vec<Event> {
        let (mut camera, mut all) = (EventCamera::default(), Vec::new());
        for &(light, at_ns) in lights {
            camera.push(sensor, &grey(light).0, at_ns, &mut all);
        }
        all
    }

    #[test]
    fn event_count_and_times_follow_from_the_contrast() {
        let all = events(&SENSOR, &[(0.1, 1_000_000), (0.5, 11_000_000)]);
        let (first, last) = (grey(0.1).1, grey(0.5).1);
        let contrast = libm::log(last / first);
        let count = (contrast / 0.2).floor() as usize;
        assert_eq!(all.len(), 6 * count, "ln {contrast}");
        for pixel in 0..6u16 {
            let of = all.iter().filter(|event| (event.x, event.y) == (pixel % 3, pixel / 3));
            for (n, event) in of.enumerate() {
                assert!(event.on);
                // The n-th threshold is reached after its share of the change.
                let at_ns = 1e6 + 1e7 * 0.2 * (n + 1) as f64 / contrast;
                assert!((event.t_ns as f64 - at_ns).abs() < 100.0, "{event:?}, not {at_ns}");
            }
        }
        assert!(all.is_sorted());
    }

    #[test]
    fn change_below_the_threshold_is_carried_over() {
        // Three times 0.15: thresholds are crossed only in the second and third image.
        let lights: Vec<_> =
            (0..4u64).map(|n| (0.2 * libm::exp(0.15 * n as f64), 1_000 + n * 1_000_000)).collect();
        let all = events(&SENSOR, &lights);
        assert_eq!(all.len(), 6 * 2);
        assert!(all[0].t_ns > 1_001_000 && all[6].t_ns > 2_001_000);
        // Decreasing brightness uses the other threshold; a step within the threshold gives no event.
        let down = events(&SENSOR, &[(0.5, 1), (0.5 * libm::exp(-0.7), 1000)]);
        assert!(down.len() == 6 * 2 && down.iter().all(|event| !event.on));
        assert!(events(&SENSOR, &[(0.5, 1), (0.45, 1000), (0.52, 2000)]).is_empty());
    }

    #[test]
    fn applies_the_dead_time_and_survives_nan_and_infinity() {
        let dead = EventSensor { dead_ns: 4_000_000, ..SENSOR };
        let all = events(&dead, &[(0.1, 0), (0.5, 10_000_000)]);
        let gaps = |all: &[Event]| {
            let of: Vec<_> = all.iter().filter(|e| (e.x, e.y) == (0, 0)).map(|e| e.t_ns).collect();
            of.windows(2).map(|pair| pair[1] - pair[0]).min()
        };
        assert!(gaps(&all).unwrap() >= 4_000_000 && all.len() < 6 * 8);
        // NaN and infinity are treated as black and white, and the loop ends.
        let sensor = EventSensor { dark: 0.001, ..SENSOR };
        let (mut camera, mut all) = (EventCamera::default(), Vec::new());
        for (n, value) in [f32::NAN, f32::INFINITY, -1.0, f32::NEG_INFINITY].into_iter().enumerate()
        {
            let mut image = grey(0.1).0;
            image.rgb.fill(value);
            camera.push(&sensor, &image, 1 + n as u64, &mut all);
        }
        assert_eq!(all.iter().filter(|event| event.on).count(), 6 * 34);
        assert_eq!(all.iter().filter(|event| !event.on).count(), 6 * 22);
        // A time that does not advance resets the state.
        camera.push(&sensor, &grey(0.9).0, 2, &mut all);
        assert_eq!(all.len(), 6 * 56);
    }
}
