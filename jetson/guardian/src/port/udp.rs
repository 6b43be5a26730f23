//! MAVLink over UDP: the socket. [`super::partner`] selects the address to reply to.

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::os::fd::OwnedFd;
use std::time::Duration;

use socket2::{Domain, Protocol, Socket, Type};

/// UDP socket, shared by a receiving thread and the control loop.
#[derive(Debug)]
pub(super) struct UdpPort {
    socket: UdpSocket,
}

impl UdpPort {
    /// Opens a socket bound to `local`.
    pub(super) fn bind(local: SocketAddr) -> io::Result<Self> {
        let socket = Socket::new(Domain::for_address(local), Type::DGRAM, Some(Protocol::UDP))?;
        // One second of telemetry. Best effort: the kernel limits the size.
        let _ = socket.set_recv_buffer_size(256 * 1024);
        socket.bind(&local.into())?;
        let socket = UdpSocket::from(socket);
        // So that a receiving thread notices the end of the flight.
        socket.set_read_timeout(Some(Duration::from_millis(100)))?;
        Ok(Self { socket })
    }

    /// Returns a port over the socket of another one.
    pub(super) fn adopt(socket: UdpSocket) -> Self {
        Self { socket }
    }

    pub(super) fn share(&self) -> io::Result<OwnedFd> {
        Ok(self.socket.try_clone()?.into())
    }

    pub(super) fn local_addr(&self) -> io::Result<SocketAddr> {
        self.socket.local_addr()
    }

    /// Waits at most 100 ms for a datagram; `None` if none arrived.
    pub(super) fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<(usize, SocketAddr)>> {
        match self.socket.recv_from(buffer) {
            Ok(received) => Ok(Some(received)),
            Err(error) => match error.kind() {
                // ConnectionRefused: nothing listened to an earlier datagram.
                io::ErrorKind::WouldBlock
                | io::ErrorKind::TimedOut
                | io::ErrorKind::Interrupted
                | io::ErrorKind::ConnectionRefused => Ok(None),
                _ => Err(error),
            },
        }
    }

    /// Sends a datagram. Errors are ignored: MAVLink tolerates loss.
    pub(super) fn send(&self, bytes: &[u8], to: SocketAddr) {
        let _ = self.socket.send_to(bytes, to);
    }
}
