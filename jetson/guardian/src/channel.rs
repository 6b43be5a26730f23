//! What runtime and guardian say to each other over a socket that keeps messages apart: one byte for the kind,
//! then the rest. Whole MAVLink packets are by far the most.

use std::io;
use std::net::SocketAddr;
use std::os::fd::{AsRawFd, BorrowedFd};

use nix::sys::socket::{MsgFlags, recv, send};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::mavlink::{SigningKey, SigningTime};
use vizflyt_protocol::packet::feed::FeedKey;

use crate::port::{LinkSigning, Wanted};

/// Larger than any datagram of MAVLink packets on an Ethernet. [bytes]
pub(crate) const MAX_MESSAGE: usize = 2049;

/// First byte of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum MessageKind {
    /// Both ways: bytes to or from the autopilot.
    Mavlink = b'M',
    /// From the runtime, first: which autopilot, and the key; [`Setup`].
    Setup = b'S',
    /// From the runtime: where poses come from, without it; [`Feed`].
    Feed = b'F',
    /// From the guardian: the port is open; its local address.
    Ready = b'R',
    /// From the guardian: the port cannot be opened; why.
    Refused = b'X',
    /// From the guardian: a sentence that people should see.
    Note = b'N',
}

impl MessageKind {
    fn of(byte: u8) -> Option<Self> {
        [Self::Mavlink, Self::Setup, Self::Feed, Self::Ready, Self::Refused, Self::Note]
            .into_iter()
            .find(|kind| *kind as u8 == byte)
    }
}

/// Which autopilot is waited for.
#[derive(Debug, Serialize, Deserialize)]
pub(crate) struct Setup {
    system: Option<u8>,
    signing: Option<([u8; 32], u64, bool)>,
}

impl Setup {
    pub(crate) fn of(wanted: &Wanted) -> Self {
        let signing = wanted.signing.as_ref();
        let signing = signing.map(|s| (*s.key.bytes(), s.start.units(), s.accepts_unsigned));
        Self { system: wanted.system, signing }
    }

    pub(crate) fn wanted(self) -> Wanted {
        let signing = self.signing.map(|(key, start, accepts_unsigned)| LinkSigning {
            key: SigningKey::new(key),
            start: SigningTime::from_units(start),
            accepts_unsigned,
        });
        Wanted { system: self.system, signing }
    }
}

/// Where the guardian gets poses by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Feed {
    /// The server's socket.
    pub server: SocketAddr,
    /// The flight's key.
    pub key: FeedKey,
    /// What the server's clock is ahead of this computer's. [ns]
    pub server_ahead_ns: i64,
}

/// Sends a message, if the other side is there and has room.
///
/// # Errors
/// The system's: nobody reads, or there is no room.
pub(crate) fn put(socket: BorrowedFd<'_>, kind: MessageKind, body: &[u8]) -> io::Result<()> {
    let mut message = [0; MAX_MESSAGE];
    let body = &body[..body.len().min(MAX_MESSAGE - 1)];
    message[0] = kind as u8;
    message[1..=body.len()].copy_from_slice(body);
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
    send(socket.as_raw_fd(), &message[..=body.len()], flags)?;
    Ok(())
}

/// Sends a structure.
///
/// # Errors
/// As [`put`].
pub(crate) fn put_body(
    socket: BorrowedFd<'_>,
    kind: MessageKind,
    body: &impl Serialize,
) -> io::Result<()> {
    let mut bytes = [0; 256];
    let body = postcard::to_slice(body, &mut bytes).map_err(io::Error::other)?;
    put(socket, kind, body)
}

/// What comes from the other side.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Received<'a> {
    /// A message.
    Message(MessageKind, &'a [u8]),
    /// None within the socket's time-out, or one of no kind that we know.
    Nothing,
    /// The other side has ended.
    Ended,
}

/// Waits for a message, for as long as the socket's time-out says.
pub(crate) fn take<'a>(socket: BorrowedFd<'_>, buffer: &'a mut [u8; MAX_MESSAGE]) -> Received<'a> {
    match recv(socket.as_raw_fd(), &mut buffer[..], MsgFlags::empty()) {
        Ok(0) => Received::Ended,
        Ok(len) => match MessageKind::of(buffer[0]) {
            Some(kind) => Received::Message(kind, &buffer[1..len]),
            None => Received::Nothing,
        },
        Err(nix::Error::EAGAIN | nix::Error::EINTR) => Received::Nothing,
        Err(_) => Received::Ended,
    }
}
