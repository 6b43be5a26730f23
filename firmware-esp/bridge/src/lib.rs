//! Firmware of the Wi-Fi bridge on a vehicle: carries MAVLink between an autopilot's serial port and a network. This
//! crate contains everything that does not depend on the chip.
//!
//! ```text
//! autopilot ══ UART ══▶ shell ─ bytes ─▶ Bridge ─ datagrams ─▶ shell ══ Wi-Fi ══▶ companion
//!           ◀══════════        ◀────────        ◀────────────        ◀═════════
//! ```
//! [`Bridge`] is sans-IO: bytes and `now` in, packets out, no allocation. Tests, fuzzers, `vizflyt bridge emulate` on
//! the host, and every chip run the same code. [`shell`] (feature `net`) drives it over embassy-net and
//! embedded-io-async. Only pins, radio and flash are specific to a chip.

#![no_std]

pub mod access;
#[cfg(feature = "net")]
pub mod blink;
pub mod bridge;
mod capacity;
pub mod dhcp;
pub mod http;
pub mod mavlink_writer;
pub mod mdns;
mod message_target;
pub mod packet;
pub mod page;
mod ring;
pub mod settings;
#[cfg(feature = "net")]
pub mod shell;
pub mod stats;
pub mod storage;
#[cfg(feature = "update")]
pub mod update;
#[cfg(feature = "net")]
pub mod wifi;

pub use bridge::{Bridge, Chip, Event, Peer};
pub use settings::Settings;
pub use stats::Stats;
