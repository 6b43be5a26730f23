//! MAVLink over UDP: a socket; whom to answer on it is in [`super::partner`].

use std::io;
use std::net::{SocketAddr, UdpSocket};
use std::time::Duration;

use socket2::{Domain, Protocol, Socket, Type};

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
