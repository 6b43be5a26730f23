//! Blink patterns of a bridge's light for each [`Light`], the same on every chip.

use embassy_time::{Duration, Timer};

use crate::shell::Light;

/// Time on, and time off, of one blink. The maximum of four blinks leaves a pause, so that they can be counted.
const HALF: Duration = Duration::from_millis(200);
/// Period of a pattern, including its pause.
const PERIOD: Duration = Duration::from_secs(2);
/// Too fast to be confused with counted blinks.
const FAST: Duration = Duration::from_millis(60);

/// Shows `light` on `led`, forever. A change takes effect after the current period.
pub async fn run(light: impl Fn() -> Light, mut led: impl FnMut(bool)) -> ! {
    loop {
        match light() {
            Light::Forwarding => {
                led(true);
                Timer::after(HALF).await;
            }
            Light::Landing => {
                led(true);
                Timer::after(FAST).await;
                led(false);
                Timer::after(FAST).await;
            }
            counted => {
                let blinks = counted as u8;
                for _ in 0..blinks {
                    led(true);
                    Timer::after(HALF).await;
                    led(false);
                    Timer::after(HALF).await;
                }
                Timer::after(PERIOD - HALF * 2 * u32::from(blinks)).await;
            }
        }
    }
}
