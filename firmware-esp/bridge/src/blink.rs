//! How a bridge's one light shows its [`Light`]: the same on every chip.

use embassy_time::{Duration, Timer};

use crate::shell::Light;

/// One blink: a fifth of a second on, as long off. Four, the most, leave a pause to count by.
const HALF: Duration = Duration::from_millis(200);
/// A period of blinks and pause.
const PERIOD: Duration = Duration::from_secs(2);
/// Fast: nobody takes it for counted blinks.
const FAST: Duration = Duration::from_millis(60);

/// Shows `light` on `led`, for ever; a change shows after the period under way.
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
