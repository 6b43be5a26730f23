//! How much memory the bridge's queues and sockets take, in one place: two sets, of which a chip takes
//! one. The smaller is for a chip whose radio needs most of its RAM (feature `small`). [bytes]

/// From the autopilot, not yet taken by every client: 89 ms at 921600 baud, or 44 ms.
pub(crate) const DOWN: usize = if SMALL { 4096 } else { 8192 };
/// Setpoints, poses and commands that wait for the autopilot's port: three of the longest, or seven.
pub(crate) const URGENT: usize = if SMALL { 1024 } else { 2048 };
/// Everything else that waits for it.
pub(crate) const NORMAL: usize = if SMALL { 2048 } else { 4096 };
/// Clients by TCP at a time; each takes 2.6 KB.
pub const TCP_SLOTS: usize = if SMALL { 1 } else { 2 };

const SMALL: bool = cfg!(feature = "small");
