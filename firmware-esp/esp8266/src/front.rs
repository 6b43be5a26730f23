//! Light, and the chip's functions for the bridge.

use core::sync::atomic::{AtomicU8, Ordering};

use vizflyt_bridge::shell::{Light, Platform};

use crate::platform;

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
pub(crate) struct Front;

impl Platform for Front {
    fn restart(&mut self) {
        platform::restart();
    }

    fn show(&mut self, light: Light) {
        LIGHT.store(light as u8, Ordering::Relaxed);
    }

    fn signal_dbm(&mut self) -> Option<i8> {
        platform::rssi_dbm()
    }

    fn overruns(&mut self) -> u32 {
        platform::uart_overruns()
    }
}
