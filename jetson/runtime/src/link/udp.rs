//! MAVLink over UDP: a socket, and whom to answer on it.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

use socket2::{Domain, Protocol, Socket, Type};

/// A partner silent for this long may be replaced by another sender: a restarted bridge comes
/// from a new port. [s]
const PARTNER_KEPT: Duration = Duration::from_secs(3);

/// The socket, shared by a receiving thread and the control loop.
#[derive(Debug)]
pub(super) struct UdpPort {
    socket: UdpSocket,
}

impl UdpPort {
    /// Opens a socket of this address.
    pub(super) fn bind(local: SocketAddr) -> io::Result<Self> {
        let socket = Socket::new(Domain::for_address(local), Type::DGRAM, Some(Protocol::UDP))?;
        // A second of telemetry; best effort, as the kernel caps it.
        let _ = socket.set_recv_buffer_size(256 * 1024);
        socket.bind(&local.into())?;
        let socket = UdpSocket::from(socket);
        // So that a receiving thread sees the end of the flight.
        socket.set_read_timeout(Some(Duration::from_millis(100)))?;
        Ok(Self { socket })
    }

    /// Returns the address bound to.
    pub(super) fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Waits for a datagram, 100 ms at most; `None` if none came.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<(usize, SocketAddr)>> {
        match self.socket.recv_from(buffer) {
            Ok(received) => Ok(Some(received)),
            Err(error) => match error.kind() {
                // ConnectionRefused: an earlier datagram of ours found nobody.
                io::ErrorKind::WouldBlock
                | io::ErrorKind::TimedOut
                | io::ErrorKind::Interrupted
                | io::ErrorKind::ConnectionRefused => Ok(None),
                _ => Err(error),
            },
        }
    }

    /// Sends a datagram; loss is the protocol's concern.
    pub(super) fn send(&self, bytes: &[u8], to: SocketAddr) {
        let _ = self.socket.send_to(bytes, to);
    }
}

/// The address to send to: a fixed one, or that of the current sender.
#[derive(Debug)]
pub(super) struct Partner {
    fixed: bool,
    current: Option<(SocketAddr, Instant)>,
}

impl Partner {
    /// The first sender.
    pub(super) fn waited_for() -> Self {
        Self { fixed: false, current: None }
    }

    /// This one, whoever else sends.
    pub(super) fn fixed(to: SocketAddr, now: Instant) -> Self {
        Self { fixed: true, current: Some((to, now)) }
    }

    /// Takes note of a sender; returns whether to accept its packets. A second sender is ignored while
    /// the first one sends.
    pub(super) fn accept(&mut self, from: SocketAddr, now: Instant) -> bool {
        match &mut self.current {
            Some((known, at)) if *known == from => {
                *at = now;
                true
            }
            Some((_, at)) if self.fixed || now.duration_since(*at) < PARTNER_KEPT => false,
            _ => {
                self.current = Some((from, now));
                true
            }
        }
    }

    /// Returns where to send.
    pub(super) fn address(&self) -> Option<SocketAddr> {
        self.current.map(|(address, _)| address)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_second_sender_waits_until_the_first_is_silent() {
        let (start, second) = (Instant::now(), Duration::from_secs(1));
        let a = SocketAddr::from(([127, 0, 0, 1], 1));
        let b = SocketAddr::from(([127, 0, 0, 1], 2));
        let mut partner = Partner::waited_for();
        assert_eq!(partner.address(), None);
        assert!(partner.accept(a, start));
        assert!(!partner.accept(b, start + second) && partner.address() == Some(a));
        assert!(partner.accept(a, start + second));
        assert!(!partner.accept(b, start + 3 * second));
        assert!(partner.accept(b, start + 4 * second) && partner.address() == Some(b));

        let mut fixed = Partner::fixed(a, start);
        assert!(!fixed.accept(b, start + 9 * second) && fixed.address() == Some(a));
    }
}
