//! Carries MAVLink between an autopilot's serial port and a network: the firmware of the Wi-Fi
//! bridge on a vehicle, without what differs between chips.
//!
//! ```text
//! autopilot ══ UART ══▶ shell ─ bytes ─▶ Bridge ─ datagrams ─▶ shell ══ Wi-Fi ══▶ companion
//!           ◀══════════        ◀────────        ◀────────────        ◀═════════
//! ```
//! [`Bridge`] is sans-IO: bytes and `now` in, packets out, no allocation; tests, fuzzers, the host's
//! `vizflyt bridge emulate` and every chip run this one. [`shell`] (feature `net`) drives it over
//! embassy-net and embedded-io-async. A chip's own part is its pins, its radio and its flash.

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
