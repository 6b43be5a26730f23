//! Messages: postcard types, one concern per file. Bounded, so that a hostile length costs
//! nothing.
//!
//! Control stream (one ordered, bidirectional QUIC stream, opened by the runtime):
//! 1. each side sends its [`crate::packet::Preamble`] and checks the other's;
//! 2. the runtime sends [`ToServer::Hello`]; the server answers [`ToRuntime::Welcome`] or
//!    [`ToRuntime::Refused`];
//! 3. then events, changed cameras and clock replies flow down; telemetry, events and clock
//!    requests up.
//!
//! Events are numbered from 1 by who makes them, and acknowledged with `EventsReceived`. Each side states at
//! the start what it has received of the other ([`ReceivedEvents`]), so that after an outage whatever is
//! missing is sent again, and nothing twice.
//!
//! Poses come as datagrams ([`Datagram`]): a lost one holds up nothing, the newest by stamp counts.
//!
//! Each message is framed by [`crate::packet::framing`]. Plugin messages ([`ToPlugin`],
//! [`FromPlugin`]) use the same encoding over shared-memory queues.

use core::fmt;

mod event;
mod kinds;
mod pairing;
mod plugin;
mod session;
mod setpoint;
mod telemetry;
mod timing;
mod trajectory;

pub use event::{Event, EventKind};
pub use kinds::{SetpointKind, SetpointKinds};
pub use pairing::{Grant, MAX_GRANTED, PairingProof, PairingReply, PairingRequest, PairingShare};
pub use plugin::{FromPlugin, MAX_ODOMETRY_PER_REPLY, Odometry, ToPlugin};
pub use session::{
    ArenaInfo, CameraInfo, ClockReply, ClockRequest, Datagram, Guarded, Hello, ImuReading, Limits,
    MAX_ALLOWANCE_S, MAX_IMU_BATCH, PoseAges, PoseSample, Purpose, ReceivedEvents, ToRuntime,
    ToServer, Welcome,
};
pub use setpoint::{Axes, InvalidSetpoint, Setpoint, YawTarget};
pub use telemetry::{FlightPhase, ImageStats, OutcomeKind, Telemetry, VehicleState};
pub use timing::{
    Arrivals, ClockState, INTERVAL_EDGES_MS, Intervals, Stage, StageTimes, Stages, Timing,
    Waterfall,
};
pub use trajectory::{
    COEFFICIENTS, MAX_PIECES, MAX_WAYPOINTS, Path, PathYaw, Piece, Trajectory, Waypoint,
};

/// Codes with which a server closes a connection and that a client acts on.
pub mod close {
    /// This computer is not paired with the server, or no longer.
    pub const UNPAIRED: u32 = 5;
}

/// A short name: of a vehicle, a camera, a stage.
pub type Name = heapless::String<32>;
/// A sentence for a person.
pub type Text = heapless::String<192>;

/// Most cameras of one vehicle.
pub const MAX_CAMERAS: usize = 8;
/// Most no-fly boxes of an arena.
pub const MAX_NO_FLY: usize = 8;

/// Returns `text` cut to what a bounded string holds, at a character boundary.
pub fn bounded<const N: usize>(text: &str) -> heapless::String<N> {
    displayed(&text)
}

/// Returns what `value` displays, cut to what a bounded string holds, at a character boundary.
pub fn displayed<const N: usize>(value: &impl fmt::Display) -> heapless::String<N> {
    struct Cut<const N: usize>(heapless::String<N>);
    impl<const N: usize> fmt::Write for Cut<N> {
        fn write_str(&mut self, text: &str) -> fmt::Result {
            text.chars().try_for_each(|c| self.0.push(c)).map_err(|_| fmt::Error)
        }
    }
    let mut out = Cut(heapless::String::new());
    // The only error is that no more fits.
    let _ = fmt::Write::write_fmt(&mut out, format_args!("{value}"));
    out.0
}
