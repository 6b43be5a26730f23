//! The runtime's end: starts the guardian, and speaks with it instead of with the autopilot's port.

use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::socket::sockopt::{ReceiveTimeout, SndBuf};
use nix::sys::socket::{
    AddressFamily, Shutdown, SockFlag, SockType, setsockopt, shutdown, socketpair,
};
use nix::sys::time::{TimeVal, TimeValLike};

use crate::channel::{Feed, MAX_MESSAGE, MessageKind, Received, Setup, put, put_body, take};
use crate::port::{MavlinkAddress, Wanted};

/// The subcommand that runs a guardian.
pub const SUBCOMMAND: &str = "guardian";
/// So long may it take to open the port.
const READY_WITHIN: Duration = Duration::from_secs(10);
/// So long may it take to leave, where the vehicle stands.
const LEAVES_WITHIN: Duration = Duration::from_secs(1);
/// Longest wait for a message. [ms]
const WAIT_MS: i64 = 100;
/// Messages that may wait, both ways: a second of packets. [bytes]
const QUEUE: usize = 256 << 10;

/// What comes from the guardian.
#[derive(Debug, PartialEq, Eq)]
pub enum Message<'a> {
    /// Bytes of the autopilot's.
    Mavlink(&'a [u8]),
    /// A sentence that people should see.
    Note(String),
}

/// Where messages are received.
pub type Buffer = [u8; MAX_MESSAGE];
/// An empty one.
pub const BUFFER: Buffer = [0; MAX_MESSAGE];

/// A guardian that runs, until this process ends or [`Self::leave`] is called, and the vehicle stands.
#[derive(Debug)]
pub struct Guardian {
    socket: OwnedFd,
    child: Mutex<Child>,
    local: String,
    has_ended: AtomicBool,
}

impl Guardian {
    /// Starts one, a process of `program`, which has the subcommand, on the port at `address`.
    ///
    /// # Errors
    /// The system's refusal of a process or of the port.
    pub fn start(program: &Path, address: &MavlinkAddress, wanted: &Wanted) -> io::Result<Self> {
        let flag = SockFlag::SOCK_CLOEXEC;
        let (ours, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, flag)?;
        for end in [&ours, &theirs] {
            setsockopt(end, SndBuf, &QUEUE)?;
        }
        setsockopt(&ours, ReceiveTimeout, &TimeVal::milliseconds(WAIT_MS))?;
        let child = Command::new(program)
            .args([SUBCOMMAND, &address.to_string()])
            .stdin(Stdio::from(theirs))
            .stdout(Stdio::null())
            // Keys that end the runtime must not end it.
            .process_group(0)
            .spawn()?;
        put_body(ours.as_fd(), MessageKind::Setup, &Setup::of(wanted))?;
        let local = wait_until_ready(&ours)?;
        let child = Mutex::new(child);
        Ok(Self { socket: ours, child, local, has_ended: AtomicBool::new(false) })
    }

    /// Returns where others reach it: the socket's address, or the device.
    pub fn local(&self) -> &str {
        &self.local
    }

    /// Returns the number of its process.
    pub fn pid(&self) -> u32 {
        self.child.lock().unwrap_or_else(PoisonError::into_inner).id()
    }

    /// Sends a packet to the autopilot; loss is the protocol's concern.
    pub fn send(&self, packet: &[u8]) {
        let _ = put(self.socket.as_fd(), MessageKind::Mavlink, packet);
    }

    /// Says where poses come from without the runtime; repeated, as the clocks drift apart.
    pub fn feed(&self, feed: &Feed) {
        let _ = put_body(self.socket.as_fd(), MessageKind::Feed, feed);
    }

    /// Tells it that the flight is over, and waits a second for it to leave: the next flight finds the port
    /// free. Where the vehicle still lands, it goes on without us.
    pub fn leave(&self) {
        self.has_ended.store(true, Ordering::Relaxed);
        let _ = shutdown(self.socket.as_raw_fd(), Shutdown::Both);
        let deadline = Instant::now() + LEAVES_WITHIN;
        while !self.has_left() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Whether its process has ended.
    pub fn has_left(&self) -> bool {
        let mut child = self.child.lock().unwrap_or_else(PoisonError::into_inner);
        !matches!(child.try_wait(), Ok(None))
    }

    /// Waits for what comes, 100 ms at most.
    ///
    /// # Errors
    /// The guardian has ended; said once, then it waits in vain.
    pub fn receive<'a>(&self, buffer: &'a mut Buffer) -> io::Result<Option<Message<'a>>> {
        if self.has_ended.load(Ordering::Relaxed) {
            thread::sleep(Duration::from_millis(100));
            return Ok(None);
        }
        match take(self.socket.as_fd(), buffer) {
            Received::Message(MessageKind::Mavlink, bytes) => Ok(Some(Message::Mavlink(bytes))),
            Received::Message(MessageKind::Note, text) => {
                Ok(Some(Message::Note(String::from_utf8_lossy(text).into_owned())))
            }
            Received::Message(..) | Received::Nothing => Ok(None),
            // We have left it, or it us.
            Received::Ended if self.has_ended.swap(true, Ordering::Relaxed) => Ok(None),
            Received::Ended => {
                Err(io::Error::other("the guardian has ended: nothing reaches the autopilot"))
            }
        }
    }
}

fn wait_until_ready(socket: &OwnedFd) -> io::Result<String> {
    let (deadline, mut buffer) = (Instant::now() + READY_WITHIN, [0; MAX_MESSAGE]);
    while Instant::now() < deadline {
        match take(socket.as_fd(), &mut buffer) {
            Received::Message(MessageKind::Ready, local) => {
                return Ok(String::from_utf8_lossy(local).into_owned());
            }
            Received::Message(MessageKind::Refused, why) => {
                return Err(io::Error::other(String::from_utf8_lossy(why).into_owned()));
            }
            Received::Message(..) | Received::Nothing => {}
            Received::Ended => return Err(io::Error::other("the guardian ended at its start")),
        }
    }
    Err(io::Error::other("the guardian does not open the port"))
}
