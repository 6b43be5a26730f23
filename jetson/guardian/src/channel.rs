//! Messages between runtime and guardian over a `SOCK_SEQPACKET` socket: one byte for the kind, then the body. Most
//! messages are whole MAVLink packets.

#![allow(unsafe_code, reason = "owns the descriptors that the kernel passes")]

use std::io::{self, IoSlice, IoSliceMut};
use std::net::SocketAddr;
use std::os::fd::{AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};

use nix::sys::socket::{
    ControlMessage, ControlMessageOwned, MsgFlags, recv, recvmsg, send, sendmsg,
};
use serde::{Deserialize, Serialize};
use vizflyt_protocol::mavlink::{SigningKey, SigningTime};
use vizflyt_protocol::packet::feed::FeedKey;

use crate::port::{LinkSigning, OpenPort, Wanted};

/// Maximum message size, larger than any datagram of MAVLink packets on Ethernet. [bytes]
pub(crate) const MAX_MESSAGE: usize = 2049;

/// Kind of a message: its first byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(crate) enum MessageKind {
    /// Both directions: bytes to or from the autopilot.
    Mavlink = b'M',
    /// From the runtime, first message: wanted autopilot and signing key ([`Setup`]).
    Setup = b'S',
    /// From the runtime: source of poses that does not depend on the runtime ([`Feed`]).
    Feed = b'F',
    /// From the guardian: the port is open; body: its local address.
    Ready = b'R',
    /// From the guardian: the port cannot be opened; body: the reason.
    Refused = b'X',
    /// From the guardian: a note for the user.
    Note = b'N',
    /// From the guardian: it runs; see [`crate::pulse`].
    Alive = b'A',
    /// From the guardian: its open port, for the case that it fails ([`OpenPort`]).
    Port = b'P',
}

impl MessageKind {
    fn of(byte: u8) -> Option<Self> {
        [Self::Mavlink, Self::Setup, Self::Feed, Self::Ready, Self::Refused, Self::Note]
            .into_iter()
            .chain([Self::Alive, Self::Port])
            .find(|kind| *kind as u8 == byte)
    }
}

/// Wanted autopilot and signing key, as sent to the guardian.
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

/// Source of poses for the guardian, independent of the runtime.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Feed {
    /// Socket address of the server.
    pub server: SocketAddr,
    /// Key of this flight.
    pub key: FeedKey,
    /// Offset of the server's clock relative to this computer's clock, positive if it is ahead. [ns]
    pub server_ahead_ns: i64,
}

/// Sends a message without blocking.
///
/// # Errors
/// Returns an error if the peer has ended or the socket's buffer is full.
pub(crate) fn put(socket: BorrowedFd<'_>, kind: MessageKind, body: &[u8]) -> io::Result<()> {
    let mut message = [0; MAX_MESSAGE];
    let body = &body[..body.len().min(MAX_MESSAGE - 1)];
    message[0] = kind as u8;
    message[1..=body.len()].copy_from_slice(body);
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
    send(socket.as_raw_fd(), &message[..=body.len()], flags)?;
    Ok(())
}

/// Serializes `body` and sends it.
///
/// # Errors
/// See [`put`].
pub(crate) fn put_body(
    socket: BorrowedFd<'_>,
    kind: MessageKind,
    body: &impl Serialize,
) -> io::Result<()> {
    let mut bytes = [0; 256];
    let body = postcard::to_slice(body, &mut bytes).map_err(io::Error::other)?;
    put(socket, kind, body)
}

/// Sends the open port without blocking.
///
/// # Errors
/// See [`put`].
pub(crate) fn put_port(socket: BorrowedFd<'_>, port: &OpenPort) -> io::Result<()> {
    let mut bytes = [0; 64];
    let body = postcard::to_slice(&port.partner, &mut bytes).map_err(io::Error::other)?;
    let numbers: Vec<RawFd> = port.descriptors.iter().map(AsRawFd::as_raw_fd).collect();
    let parts = [IoSlice::new(&[MessageKind::Port as u8]), IoSlice::new(body)];
    let rights = [ControlMessage::ScmRights(&numbers)];
    let rights = if numbers.is_empty() { &rights[..0] } else { &rights[..] };
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
    sendmsg::<()>(socket.as_raw_fd(), &parts, rights, flags, None)?;
    Ok(())
}

/// Result of [`take`].
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Received<'a> {
    Message(MessageKind, &'a [u8]),
    /// No message within the socket's timeout, or a message of unknown kind.
    Nothing,
    /// The peer has ended.
    Ended,
}

/// Waits for a message, at most for the socket's timeout.
pub(crate) fn take<'a>(socket: BorrowedFd<'_>, buffer: &'a mut [u8; MAX_MESSAGE]) -> Received<'a> {
    match recv(socket.as_raw_fd(), &mut buffer[..], MsgFlags::empty()) {
        Ok(len) => message(&buffer[..len]),
        Err(error) => failed(error),
    }
}

/// As [`take`], with the descriptors of the message.
pub(crate) fn take_with_descriptors<'a>(
    socket: BorrowedFd<'_>,
    buffer: &'a mut [u8; MAX_MESSAGE],
) -> (Received<'a>, Vec<OwnedFd>) {
    let mut control = nix::cmsg_space!([RawFd; 2]);
    let mut descriptors = Vec::new();
    let len = {
        let mut parts = [IoSliceMut::new(buffer)];
        let flags = MsgFlags::MSG_CMSG_CLOEXEC;
        match recvmsg::<()>(socket.as_raw_fd(), &mut parts, Some(&mut control), flags) {
            Ok(received) => {
                for message in received.cmsgs().into_iter().flatten() {
                    if let ControlMessageOwned::ScmRights(numbers) = message {
                        // SAFETY: the kernel has just opened them for this process, and no other code has their numbers.
                        let own = |number| unsafe { OwnedFd::from_raw_fd(number) };
                        descriptors.extend(numbers.into_iter().map(own));
                    }
                }
                received.bytes
            }
            Err(error) => return (failed(error), descriptors),
        }
    };
    (message(&buffer[..len]), descriptors)
}

fn message(bytes: &[u8]) -> Received<'_> {
    match bytes.split_first() {
        None => Received::Ended,
        Some((&kind, body)) => match MessageKind::of(kind) {
            Some(kind) => Received::Message(kind, body),
            None => Received::Nothing,
        },
    }
}

fn failed<'a>(error: nix::Error) -> Received<'a> {
    match error {
        nix::Error::EAGAIN | nix::Error::EINTR => Received::Nothing,
        _ => Received::Ended,
    }
}
