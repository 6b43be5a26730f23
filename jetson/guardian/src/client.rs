//! Runtime's end of the guardian: starts its process, exchanges messages with it, and replaces it if it fails.

use std::io;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::socket::sockopt::{ReceiveTimeout, SndBuf};
use nix::sys::socket::{
    AddressFamily, Shutdown, SockFlag, SockType, setsockopt, shutdown, socketpair,
};
use nix::sys::time::{TimeVal, TimeValLike};

use crate::channel::{
    Feed, MAX_MESSAGE, MessageKind, Received, Setup, put, put_body, take, take_with_descriptors,
};
use crate::host_now;
use crate::port::{MavlinkAddress, OpenPort, Port, Wanted};
use crate::pulse::{Pulse, may_bypass};

/// Subcommand that runs a guardian.
pub const SUBCOMMAND: &str = "guardian";
/// Timeout for opening the port.
const READY_WITHIN: Duration = Duration::from_secs(10);
/// Timeout for the guardian's end after a flight, if the vehicle is on the ground.
const LEAVES_WITHIN: Duration = Duration::from_secs(1);
/// Maximum wait for a message. [ms]
const WAIT_MS: i64 = 50;
/// Size of the queue in each direction: one second of packets. [bytes]
const QUEUE: usize = 256 << 10;

/// Message from the guardian.
#[derive(Debug, PartialEq, Eq)]
pub enum Message<'a> {
    /// Bytes from the autopilot.
    Mavlink(&'a [u8]),
    /// Note for the user.
    Note(String),
    /// The guardian has failed. From now on, the port carries only what lands the vehicle; received once.
    Failed(&'static str),
}

/// Receive buffer for messages.
pub type Buffer = [u8; MAX_MESSAGE];
/// Empty receive buffer.
pub const BUFFER: Buffer = [0; MAX_MESSAGE];

/// Running guardian. Its process ends when this process has ended or called [`Self::leave`], and the vehicle is on the
/// ground.
#[derive(Debug)]
pub struct Guardian {
    socket: OwnedFd,
    child: Mutex<Child>,
    local: String,
    address: MavlinkAddress,
    wanted: Wanted,
    made_at: Instant,
    has_ended: AtomicBool,
    pulse: Mutex<Pulse>,
    /// Open port of the guardian.
    spare: Mutex<Option<OpenPort>>,
    /// Port after a failure of the guardian.
    direct: OnceLock<Port>,
}

impl Guardian {
    /// Starts a guardian for the port at `address`: `program` with the subcommand [`SUBCOMMAND`].
    ///
    /// # Errors
    /// Returns an error if the process cannot be started or the port cannot be opened.
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
            // Keys that end the runtime, such as Ctrl-C, must not end the guardian.
            .process_group(0)
            .spawn()?;
        let made_at = Instant::now();
        put_body(ours.as_fd(), MessageKind::Setup, &Setup::of(wanted))?;
        let local = wait_until_ready(&ours)?;
        Ok(Self {
            socket: ours,
            child: Mutex::new(child),
            local,
            address: address.clone(),
            wanted: wanted.clone(),
            made_at,
            has_ended: AtomicBool::new(false),
            pulse: Mutex::new(Pulse::new(host_now())),
            spare: Mutex::default(),
            direct: OnceLock::new(),
        })
    }

    /// Returns the local end of the link: the socket's address, or the device.
    pub fn local(&self) -> &str {
        &self.local
    }

    /// Returns the process id of the guardian.
    pub fn pid(&self) -> u32 {
        self.child.lock().unwrap_or_else(PoisonError::into_inner).id()
    }

    /// Sends a packet to the autopilot; after a failure of the guardian, only if it [ends the
    /// flight](crate::pulse::may_bypass). Errors are ignored: MAVLink tolerates loss.
    pub fn send(&self, packet: &[u8]) {
        if let Some(port) = self.direct.get() {
            if may_bypass(packet) {
                port.send(packet);
            }
            return;
        }
        let _ = put(self.socket.as_fd(), MessageKind::Mavlink, packet);
    }

    /// Sends the source of poses for the time after the runtime's end. Repeated, because the clocks drift.
    pub fn feed(&self, feed: &Feed) {
        let _ = put_body(self.socket.as_fd(), MessageKind::Feed, feed);
    }

    /// Ends the connection, and waits up to 1 s until the guardian has ended, so that the next flight finds the port
    /// free. If the vehicle is still landing, the guardian keeps running.
    pub fn leave(&self) {
        self.has_ended.store(true, Ordering::Relaxed);
        *self.spare.lock().unwrap_or_else(PoisonError::into_inner) = None;
        let _ = shutdown(self.socket.as_raw_fd(), Shutdown::Both);
        let deadline = Instant::now() + LEAVES_WITHIN;
        while !self.has_left() && Instant::now() < deadline {
            thread::sleep(Duration::from_millis(5));
        }
    }

    /// Whether the guardian's process has ended.
    pub fn has_left(&self) -> bool {
        let mut child = self.child.lock().unwrap_or_else(PoisonError::into_inner);
        !matches!(child.try_wait(), Ok(None))
    }

    /// Waits at most 100 ms for a message. Call it again at once: it also monitors the guardian.
    ///
    /// # Errors
    /// Returns an error once, if the guardian has failed and its port is lost. Later calls return `None` after 100 ms.
    pub fn receive<'a>(&self, buffer: &'a mut Buffer) -> io::Result<Option<Message<'a>>> {
        if let Some(port) = self.direct.get() {
            let received = port.receive(&mut buffer[..]).unwrap_or_else(|_| {
                thread::sleep(Duration::from_millis(100));
                None
            });
            return Ok(received.map(|len| Message::Mavlink(&buffer[..len])));
        }
        if self.has_ended.load(Ordering::Relaxed) {
            thread::sleep(Duration::from_millis(100));
            return Ok(None);
        }
        let (received, descriptors) = take_with_descriptors(self.socket.as_fd(), buffer);
        let mut pulse = self.pulse.lock().unwrap_or_else(PoisonError::into_inner);
        match received {
            Received::Message(MessageKind::Alive, _) => pulse.note_alive(host_now()),
            // An end after `leave` is not a failure.
            Received::Ended if self.has_ended.load(Ordering::Relaxed) => return Ok(None),
            Received::Ended => return self.replace("the guardian has ended").map(Some),
            _ if pulse.has_failed(host_now()) => {
                return self.replace("the guardian does not answer").map(Some);
            }
            Received::Message(MessageKind::Mavlink, bytes) => {
                return Ok(Some(Message::Mavlink(bytes)));
            }
            Received::Message(MessageKind::Note, text) => {
                return Ok(Some(Message::Note(String::from_utf8_lossy(text).into_owned())));
            }
            Received::Message(MessageKind::Port, body) => {
                if let Ok(partner) = postcard::from_bytes(body) {
                    *self.spare.lock().unwrap_or_else(PoisonError::into_inner) =
                        Some(OpenPort { partner, descriptors });
                }
            }
            Received::Message(..) | Received::Nothing => {}
        }
        Ok(None)
    }

    /// Kills a guardian that has failed, so that it cannot send any more, and takes its port.
    fn replace(&self, failure: &'static str) -> io::Result<Message<'static>> {
        let _ = self.child.lock().unwrap_or_else(PoisonError::into_inner).kill();
        let spare = self.spare.lock().unwrap_or_else(PoisonError::into_inner).take();
        let port = spare
            .ok_or(io::ErrorKind::NotConnected.into())
            .and_then(|open| Port::adopt(&self.address, self.wanted.clone(), self.made_at, open))
            .or_else(|_| Port::open(&self.address, self.wanted.clone()));
        match port {
            Ok(port) => {
                let _ = self.direct.set(port);
                Ok(Message::Failed(failure))
            }
            Err(error) => {
                self.has_ended.store(true, Ordering::Relaxed);
                let why = format!("{failure}, and nothing reaches the autopilot: {error}");
                Err(io::Error::other(why))
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
    Err(io::Error::other("the guardian did not open the port within 10 s"))
}
