//! The port's pins, as the settings name them.

use esp_hal::gpio::AnyPin;
use vizflyt_bridge::settings::UartPins;

/// The pins that a port may have, each until it is taken.
pub(crate) struct Pins(pub(crate) [(u8, Option<AnyPin<'static>>); 10]);

/// The pins of a port.
pub(crate) struct Port {
    pub(crate) tx: AnyPin<'static>,
    pub(crate) rx: AnyPin<'static>,
    pub(crate) rts: AnyPin<'static>,
    pub(crate) cts: AnyPin<'static>,
}

impl Pins {
    /// Takes the settings' pins. They are four different ones of ours: the settings refuse others.
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
