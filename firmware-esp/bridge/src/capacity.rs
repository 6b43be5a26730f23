//! Memory sizes of the bridge's queues and sockets [bytes]. There are two sets; the smaller one (feature `small`) is
//! for a chip whose radio needs most of its RAM.

/// Packets from the autopilot that not all clients have read: 89 ms at 921600 baud, or 44 ms with `small`.
pub(crate) const DOWN: usize = if SMALL { 4096 } else { 8192 };
/// Setpoints, poses and commands for the autopilot's port: seven of maximum length, or three with `small`.
pub(crate) const URGENT: usize = if SMALL { 1024 } else { 2048 };
/// All other packets for the autopilot's port.
pub(crate) const NORMAL: usize = if SMALL { 2048 } else { 4096 };
/// Maximum number of TCP clients; each takes 2.6 KB.
pub const TCP_SLOTS: usize = if SMALL { 1 } else { 2 };

const SMALL: bool = cfg!(feature = "small");
