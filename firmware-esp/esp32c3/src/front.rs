//! Light and button, and the chip's functions for the bridge.

use core::sync::atomic::{AtomicU8, Ordering};

use embassy_time::{Duration, Instant, Timer};
use embedded_storage::nor_flash::NorFlash;
use esp_hal::gpio::Input;
use esp_println::println;
use vizflyt_bridge::shell::{Light, Platform};
use vizflyt_bridge::stats::RestartCause;

use crate::flash::{self, Flash};
use crate::restart::Watchdog;
use crate::update::Updates;
use crate::{radio, serial};

/// Time to hold the button until the settings, including the key, are erased.
const HELD: Duration = Duration::from_secs(5);

static LIGHT: AtomicU8 = AtomicU8::new(Light::NoNetwork as u8);

/// Returns the state for the light.
pub(crate) fn light() -> Light {
    let code = LIGHT.load(Ordering::Relaxed);
    [Light::Forwarding, Light::NoAutopilot, Light::NoClient, Light::Unclaimed, Light::Landing]
        .into_iter()
        .find(|&light| light as u8 == code)
        .unwrap_or(Light::NoNetwork)
}

/// The chip's implementation of [`Platform`].
pub(crate) struct Front {
    /// `None` if firmware over the network is not accepted.
    pub(crate) updates: Option<Updates>,
    pub(crate) watchdog: Watchdog,
    pub(crate) cause: RestartCause,
}

impl Platform for Front {
    fn restart(&mut self) {
        esp_hal::system::software_reset();
    }

    fn show(&mut self, light: Light) {
        println!("{light:?}");
        LIGHT.store(light as u8, Ordering::Relaxed);
    }

    fn signal_dbm(&mut self) -> Option<i8> {
        radio::signal_dbm()
    }

    fn overruns(&mut self) -> u32 {
        serial::overruns()
    }

    fn restart_cause(&mut self) -> RestartCause {
        self.cause
    }

    fn feed(&mut self) {
        self.watchdog.feed();
    }

    fn update(&mut self, first: bool, bytes: &[u8]) -> Result<bool, &'static str> {
        match &mut self.updates {
            Some(updates) => updates.take(first, bytes),
            None => Err("this bridge was built without a firmware key; flash it by wire"),
        }
    }
}

/// Watches the button, forever. If it is held, erases the settings and restarts.
pub(crate) async fn watch(button: Input<'static>, flash: &'static Flash) -> ! {
    let mut released_at = Instant::now();
    loop {
        Timer::after(Duration::from_millis(100)).await;
        if button.is_high() {
            released_at = Instant::now();
        }
        if released_at.elapsed() >= HELD {
            let mut settings = flash::settings(flash);
            let len = settings.len;
            match settings.erase(0, len) {
                Ok(()) => println!("settings erased"),
                Err(error) => println!("settings not erased: {error:?}"),
            }
            esp_hal::system::software_reset();
        }
    }
}
