//! Numeric settings, each also a MAVLink parameter of the bridge's component.

use super::{Refused, Settings, WifiRole};

/// Numeric setting and its limits.
#[derive(Clone, Copy, Debug)]
pub struct Number {
    /// Name, at most 16 characters.
    pub name: &'static str,
    /// Minimum.
    pub least: u32,
    /// Maximum.
    pub most: u32,
    /// Whether 0 is also allowed; it turns the feature off.
    pub zero: bool,
    /// Forbidden values within the range, as bits: bit 3 is the value 3.
    pub except: u32,
    /// Whether a change takes effect only after a restart.
    pub at_restart: bool,
    read: fn(&Settings) -> u32,
    write: fn(&mut Settings, u32),
}

/// All numbers, in the order of their parameter index.
pub const NUMBERS: &[Number] = &[
    number("UART_BAUD", 57_600, 3_000_000, true, |s| s.baud, |s, v| s.baud = v),
    number("UART_FLOW", 0, 1, true, |s| s.flow_control.into(), |s, v| s.flow_control = v != 0),
    number("BATCH_US", 0, 20_000, false, |s| s.batch_us, |s, v| s.batch_us = v),
    number(
        "BATCH_BYTES",
        300,
        1400,
        false,
        |s| s.batch_bytes.into(),
        |s, v| {
            s.batch_bytes = v as u16;
        },
    ),
    number(
        "CLIENT_TIMEOUT_S",
        2,
        600,
        false,
        |s| s.client_timeout_s.into(),
        |s, v| {
            s.client_timeout_s = v as u16;
        },
    ),
    number("UDP_PORT", 1, 65_535, true, |s| s.udp_port.into(), |s, v| s.udp_port = v as u16),
    number("TCP_PORT", 0, 65_535, true, |s| s.tcp_port.into(), |s, v| s.tcp_port = v as u16),
    number("PAGE_PORT", 0, 65_535, true, |s| s.page_port.into(), |s, v| s.page_port = v as u16),
    Number {
        zero: true,
        ..number("LOSS_MS", 200, 10_000, false, |s| s.loss_ms.into(), |s, v| s.loss_ms = v as u16)
    },
    number("RADIO_STATUS", 0, 1, false, |s| s.radio_status.into(), |s, v| s.radio_status = v != 0),
    number("BEACON", 0, 1, false, |s| s.beacon.into(), |s, v| s.beacon = v != 0),
    number(
        "WIFI_STATION",
        0,
        1,
        true,
        |s| u32::from(s.wifi_role == WifiRole::Station),
        |s, v| {
            s.wifi_role = if v == 0 { WifiRole::AccessPoint } else { WifiRole::Station };
        },
    ),
    number("WIFI_CHANNEL", 1, 13, true, |s| s.wifi_channel.into(), |s, v| s.wifi_channel = v as u8),
    number(
        "WIFI_FALLBACK_S",
        5,
        600,
        true,
        |s| s.fallback_s.into(),
        |s, v| {
            s.fallback_s = v as u16;
        },
    ),
    number(
        "WIFI_OPEN",
        0,
        1,
        true,
        |s| s.wifi_open.into(),
        |s, v| {
            s.wifi_open = v != 0;
        },
    ),
    number("TRANSPARENT", 0, 1, true, |s| s.transparent.into(), |s, v| s.transparent = v != 0),
    pin("UART_TX_PIN", |s| s.pins.tx.into(), |s, v| s.pins.tx = v as u8),
    pin("UART_RX_PIN", |s| s.pins.rx.into(), |s, v| s.pins.rx = v as u8),
    pin("UART_RTS_PIN", |s| s.pins.rts.into(), |s, v| s.pins.rts = v as u8),
    pin("UART_CTS_PIN", |s| s.pins.cts.into(), |s, v| s.pins.cts = v as u8),
];

/// Pin of the ESP32-C3; other chips ignore it. GPIO8 to 10 are lights and button, 11 to 17 the flash, 18 and 19 USB.
const fn pin(
    name: &'static str,
    read: fn(&Settings) -> u32,
    write: fn(&mut Settings, u32),
) -> Number {
    Number { except: 0x000F_FF00, ..number(name, 0, 21, true, read, write) }
}

const fn number(
    name: &'static str,
    least: u32,
    most: u32,
    at_restart: bool,
    read: fn(&Settings) -> u32,
    write: fn(&mut Settings, u32),
) -> Number {
    Number { name, least, most, zero: false, except: 0, at_restart, read, write }
}

impl Number {
    pub fn value(&self, settings: &Settings) -> u32 {
        (self.read)(settings)
    }

    /// Sets the value.
    ///
    /// # Errors
    /// [`Refused::OutOfRange`].
    pub fn set(&self, settings: &mut Settings, value: u32) -> Result<(), Refused> {
        let excepted = value < 32 && self.except & (1 << value) != 0;
        let allowed = (self.least..=self.most).contains(&value) && !excepted;
        if allowed || (self.zero && value == 0) {
            (self.write)(settings, value);
            Ok(())
        } else {
            Err(Refused::OutOfRange)
        }
    }
}
