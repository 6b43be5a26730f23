//! Messages: postcard types, one concern per file. All sizes are bounded, so that a malicious length cannot cause an
//! allocation.
//!
//! Control stream (one ordered, bidirectional QUIC stream, opened by the runtime):
//! 1. Each side sends its [`crate::packet::Preamble`] and checks the other's.
//! 2. The runtime sends [`ToServer::Hello`]; the server answers [`ToRuntime::Welcome`] or [`ToRuntime::Refused`].
//! 3. Then the server sends events, camera changes and clock replies; the runtime sends telemetry, events and clock
//!    requests.
//!
//! Each sender numbers its events from 1, and the receiver acknowledges them with `EventsReceived`. At the start, each
//! side states the events that it has received from the other ([`ReceivedEvents`]). After an outage, missing events are
//! sent again, and none is delivered twice.
//!
//! Poses are sent as datagrams ([`Datagram`]): a lost one delays nothing, and the newest stamp counts.
//!
//! [`crate::packet::framing`] frames each message. Plugin messages ([`ToPlugin`], [`FromPlugin`]) use the same encoding
//! over shared-memory queues.

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

/// QUIC close codes that a client handles.
pub mod close {
    /// This computer is not paired with the server, or its pairing was removed.
    pub const UNPAIRED: u32 = 5;
}

/// Short name of a vehicle, a camera or a stage.
pub type Name = heapless::String<32>;
/// Sentence for a person.
pub type Text = heapless::String<192>;

/// Maximum number of cameras per vehicle.
pub const MAX_CAMERAS: usize = 8;
/// Maximum number of no-fly boxes per arena.
pub const MAX_NO_FLY: usize = 8;

/// Returns `text`, truncated to the capacity at a character boundary.
pub fn bounded<const N: usize>(text: &str) -> heapless::String<N> {
    displayed(&text)
}

/// Returns the displayed form of `value`, truncated to the capacity at a character boundary.
pub fn displayed<const N: usize>(value: &impl fmt::Display) -> heapless::String<N> {
    struct Cut<const N: usize>(heapless::String<N>);
    impl<const N: usize> fmt::Write for Cut<N> {
        fn write_str(&mut self, text: &str) -> fmt::Result {
            text.chars().try_for_each(|c| self.0.push(c)).map_err(|_| fmt::Error)
        }
    }
    let mut out = Cut(heapless::String::new());
    // The only possible error is a full string.
    let _ = fmt::Write::write_fmt(&mut out, format_args!("{value}"));
    out.0
}
