//! UART pins according to the settings.

use esp_hal::gpio::AnyPin;
use vizflyt_bridge::settings::UartPins;

/// Pins that a port may use, until they are taken.
pub(crate) struct Pins(pub(crate) [(u8, Option<AnyPin<'static>>); 10]);

/// UART pins of a port.
pub(crate) struct Port {
    pub(crate) tx: AnyPin<'static>,
    pub(crate) rx: AnyPin<'static>,
    pub(crate) rts: AnyPin<'static>,
    pub(crate) cts: AnyPin<'static>,
}

impl Pins {
    /// Takes the pins of the settings. Settings with other or duplicate pins are rejected earlier.
    pub(crate) fn take(mut self, pins: UartPins) -> Option<Port> {
        let pins = pins.or_usual();
        Some(Port {
            tx: self.one(pins.tx)?,
            rx: self.one(pins.rx)?,
            rts: self.one(pins.rts)?,
            cts: self.one(pins.cts)?,
        })
    }

    fn one(&mut self, number: u8) -> Option<AnyPin<'static>> {
        self.0.iter_mut().find(|(known, _)| *known == number)?.1.take()
    }
}
