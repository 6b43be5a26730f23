//! Socket between both ends: ordered packets, some with descriptors, local to this computer (unix(7),
//! `SOCK_SEQPACKET`).

#![allow(unsafe_code, reason = "owns the descriptors that the kernel passes")]

use std::io::{IoSlice, IoSliceMut};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::time::Duration;

use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{ControlMessage, ControlMessageOwned, MsgFlags, recv, recvmsg, sendmsg};
use vizflyt_protocol::packet::framing::MAX_FRAMED;

/// Kind of a packet; its first byte.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PacketKind {
    /// First packet in each direction. The runtime's contains its protocol version, board and bell. The plugin's
    /// reports that it has attached.
    Hello,
    /// Message of the protocol.
    Message,
    /// Number and memory of a slot that is new or has grown.
    Slot,
}

impl PacketKind {
    fn of(byte: u8) -> Option<Self> {
        [Self::Hello, Self::Message, Self::Slot].get(usize::from(byte)).copied()
    }
}

/// Maximum size of a packet.
type Buffer = [u8; 1 + MAX_FRAMED];

pub(super) const EMPTY: Buffer = [0; 1 + MAX_FRAMED];

/// Result of reading a socket.
#[derive(Debug)]
pub(super) enum Received<'b> {
    /// Packet with its descriptors.
    Packet(PacketKind, &'b [u8], Vec<OwnedFd>),
    /// Packet of unknown kind.
    Garbage,
    /// No packet is waiting.
    Nothing,
    /// The other side has closed.
    Closed,
}

/// Sends a packet without waiting. Returns [`Errno::EAGAIN`] if the socket is full.
pub(super) fn send(
    socket: BorrowedFd<'_>,
    kind: PacketKind,
    body: &[u8],
    descriptors: &[RawFd],
) -> Result<(), Errno> {
    let head = [kind as u8];
    let parts = [IoSlice::new(&head), IoSlice::new(body)];
    let rights = [ControlMessage::ScmRights(descriptors)];
    let rights = if descriptors.is_empty() { &rights[..0] } else { &rights[..] };
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_NOSIGNAL;
    sendmsg::<()>(socket.as_raw_fd(), &parts, rights, flags, None).map(|_| ())
}

/// Receives a packet with its descriptors, without waiting.
pub(super) fn receive_with_descriptors<'b>(
    socket: BorrowedFd<'_>,
    buffer: &'b mut Buffer,
) -> Result<Received<'b>, Errno> {
    // Space for two descriptors; the kernel closes further ones.
    let mut control = nix::cmsg_space!([RawFd; 2]);
    let (len, descriptors) = {
        let mut parts = [IoSliceMut::new(buffer)];
        let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_CMSG_CLOEXEC;
        let received =
            match recvmsg::<()>(socket.as_raw_fd(), &mut parts, Some(&mut control), flags) {
                Ok(received) => received,
                Err(error) => return none_or(error),
            };
        let mut descriptors = Vec::new();
        for message in received.cmsgs()? {
            if let ControlMessageOwned::ScmRights(numbers) = message {
                descriptors.extend(numbers.into_iter().map(owned));
            }
        }
        (received.bytes, descriptors)
    };
    Ok(packet(&buffer[..len], descriptors))
}

/// Receives a packet without waiting. The kernel closes descriptors sent with it, so that a plugin cannot fill the
/// runtime's file table.
pub(super) fn receive<'b>(
    socket: BorrowedFd<'_>,
    buffer: &'b mut Buffer,
) -> Result<Received<'b>, Errno> {
    match recv(socket.as_raw_fd(), buffer, MsgFlags::MSG_DONTWAIT) {
        Ok(len) => Ok(packet(&buffer[..len], Vec::new())),
        Err(error) => none_or(error),
    }
}

/// Returns the kind of the next packet without removing it. Does not wait.
pub(super) fn peek<'b>(
    socket: BorrowedFd<'_>,
    buffer: &'b mut [u8; 1],
) -> Result<Received<'b>, Errno> {
    match recv(socket.as_raw_fd(), buffer, MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_PEEK) {
        Ok(len) => Ok(packet(&buffer[..len], Vec::new())),
        Err(error) => none_or(error),
    }
}

/// Owns a descriptor that the kernel has just opened for this process.
pub(super) fn owned(number: RawFd) -> OwnedFd {
    // SAFETY: it is open, and no other code has its number.
    unsafe { OwnedFd::from_raw_fd(number) }
}

/// Waits until one descriptor is readable, at most `timeout`. Returns whether one is.
pub(super) fn wait_readable(
    descriptors: &[BorrowedFd<'_>],
    timeout: Duration,
) -> Result<bool, Errno> {
    wait_for(descriptors, PollFlags::POLLIN, timeout)
}

/// Waits until the socket is writable, at most `timeout`. Returns whether it is.
pub(super) fn wait_writable(socket: &OwnedFd, timeout: Duration) -> Result<bool, Errno> {
    wait_for(&[socket.as_fd()], PollFlags::POLLOUT, timeout)
}

fn wait_for(
    descriptors: &[BorrowedFd<'_>],
    flags: PollFlags,
    timeout: Duration,
) -> Result<bool, Errno> {
    let mut polled: heapless::Vec<_, 2> =
        descriptors.iter().map(|&descriptor| PollFd::new(descriptor, flags)).collect();
    // Rounded up, so that a wait of less than a millisecond does not become a busy loop.
    let timeout = timeout.as_nanos().div_ceil(1_000_000).try_into().unwrap_or(u16::MAX);
    match poll(&mut polled, PollTimeout::from(timeout)) {
        Ok(ready) => Ok(ready > 0),
        // A signal such as Ctrl-C is left to its handler.
        Err(Errno::EINTR) => Ok(false),
        Err(error) => Err(error),
    }
}

fn packet(bytes: &[u8], descriptors: Vec<OwnedFd>) -> Received<'_> {
    match bytes.split_first() {
        None => Received::Closed,
        Some((&kind, body)) => match PacketKind::of(kind) {
            Some(kind) => Received::Packet(kind, body, descriptors),
            None => Received::Garbage,
        },
    }
}

fn none_or<'b>(error: Errno) -> Result<Received<'b>, Errno> {
    match error {
        Errno::EAGAIN | Errno::EINTR => Ok(Received::Nothing),
        Errno::ECONNRESET => Ok(Received::Closed),
        error => Err(error),
    }
}
