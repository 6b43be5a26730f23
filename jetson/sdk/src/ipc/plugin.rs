//! The plugin's end: takes the newest observation, receives messages, sends replies.

use std::collections::VecDeque;
use std::os::fd::{AsFd, OwnedFd};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use memmap2::Mmap;
use nix::errno::Errno;
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, ToPlugin};
use vizflyt_protocol::packet::PreambleError;
use vizflyt_protocol::packet::framing::{self, FramingError, MAX_FRAMED};

use super::board::Board;
use super::runtime::PluginSocket;
use super::sealed::{map_read_only, take_inherited};
use super::socket::{self, EMPTY, PacketKind, Received};
use super::{BORROWED_OBSERVATIONS, IpcError, SLOTS, offer};

/// The plugin's end of the connection.
#[derive(Debug)]
pub struct PluginEnd {
    socket: OwnedFd,
    bell: OwnedFd,
    borrowed: Arc<Borrowed>,
    inbox: Mutex<Inbox>,
}

/// An observation in shared memory. The runtime does not reuse the memory before this is dropped.
#[derive(Debug)]
pub struct ObservationSample {
    memory: Arc<Mmap>,
    len: usize,
    slot: usize,
    borrowed: Arc<Borrowed>,
}

/// Number of borrowed observations, and the board on which they are returned.
#[derive(Debug)]
struct Borrowed {
    board: Board,
    count: AtomicUsize,
}

/// Packets received over the socket.
#[derive(Debug, Default)]
struct Inbox {
    slots: [Option<Arc<Mmap>>; SLOTS],
    messages: VecDeque<Result<ToPlugin, FramingError>>,
    is_closed: bool,
}

impl PluginEnd {
    /// Attaches to the runtime at `service`: `fd:N`, an inherited socket, or the path of a socket.
    ///
    /// # Errors
    /// [`IpcError::NoRuntime`] if there is none or it already has a plugin, [`IpcError::Version`] if its protocol
    /// version differs.
    pub fn open(service: &str) -> Result<Self, IpcError> {
        let nobody = || IpcError::NoRuntime(service.to_owned());
        let socket = match service.strip_prefix("fd:") {
            Some(number) => {
                let number = number.parse().map_err(|_| nobody())?;
                take_inherited(number).map_err(|_| nobody())?
            }
            None => offer::connect(Path::new(service)).map_err(|_| nobody())?,
        };
        Self::greet(socket)?.ok_or_else(nobody)
    }

    /// Attaches to a runtime in this process.
    ///
    /// # Errors
    /// As [`Self::open`].
    pub fn attach(socket: PluginSocket) -> Result<Self, IpcError> {
        Self::greet(socket.into_inner())?.ok_or_else(|| IpcError::NoRuntime("this".to_owned()))
    }

    /// Receives the runtime's first packet and replies to it. `None` if no packet arrives.
    fn greet(socket: OwnedFd) -> Result<Option<Self>, IpcError> {
        let attaching = "attaching to the runtime";
        socket::wait_readable(&[socket.as_fd()], HELLO_WITHIN)
            .map_err(IpcError::system(attaching))?;
        let mut buffer = EMPTY;
        let received = socket::receive_with_descriptors(socket.as_fd(), &mut buffer)
            .map_err(IpcError::system(attaching))?;
        let Received::Packet(PacketKind::Hello, version, descriptors) = received else {
            return Ok(None);
        };
        check_version(version.try_into().map_or(0, u16::from_le_bytes))?;
        let Ok([board, bell]) = <[OwnedFd; 2]>::try_from(descriptors) else { return Ok(None) };
        let board = Board::open(board).map_err(IpcError::system(attaching))?;
        let end = Self {
            socket,
            bell,
            borrowed: Arc::new(Borrowed { board, count: AtomicUsize::default() }),
            inbox: Mutex::default(),
        };
        end.send_packet(PacketKind::Hello, &[])?;
        Ok(Some(end))
    }

    /// Waits for a message or an observation, at most `timeout`. Returns whether there is one. It also returns true if
    /// the runtime has ended, which [`Self::receive`] then returns as an error.
    ///
    /// # Errors
    /// [`IpcError::System`].
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        let waiting = "waiting for the runtime";
        let woken = socket::wait_readable(&[self.socket.as_fd(), self.bell.as_fd()], timeout)
            .map_err(IpcError::system(waiting))?;
        match nix::unistd::read(&self.bell, &mut [0; 8]) {
            Ok(_) | Err(Errno::EAGAIN | Errno::EINTR) => Ok(woken),
            Err(error) => Err(IpcError::system(waiting)(error)),
        }
    }

    /// Takes the next message of the runtime, if any.
    ///
    /// # Errors
    /// [`IpcError::Gone`] if the runtime has ended and all its messages are taken.
    pub fn receive(&self) -> Result<Option<ToPlugin>, IpcError> {
        let mut inbox = self.inbox.lock().unwrap_or_else(PoisonError::into_inner);
        inbox.fill(&self.socket)?;
        match inbox.messages.pop_front() {
            Some(message) => Ok(Some(message?)),
            None if inbox.is_closed => Err(IpcError::Gone("runtime")),
            None => Ok(None),
        }
    }

    /// Takes the newest observation, unless it was taken before.
    ///
    /// # Errors
    /// [`IpcError::NoSlot`] if [`BORROWED_OBSERVATIONS`] are in use.
    pub fn observation(&self) -> Result<Option<ObservationSample>, IpcError> {
        let borrowed = &self.borrowed;
        if borrowed.count.load(Ordering::Acquire) >= BORROWED_OBSERVATIONS {
            return Err(IpcError::NoSlot(BORROWED_OBSERVATIONS));
        }
        let Some(place) = borrowed.board.take() else { return Ok(None) };
        let mut inbox = self.inbox.lock().unwrap_or_else(PoisonError::into_inner);
        // The slot's memory is sent before the first observation is published in it.
        inbox.fill(&self.socket)?;
        let memory = inbox.slots[place.slot].clone().filter(|memory| memory.len() >= place.len);
        let Some(memory) = memory else { return Ok(None) };
        borrowed.count.fetch_add(1, Ordering::AcqRel);
        let borrowed = Arc::clone(borrowed);
        Ok(Some(ObservationSample { memory, len: place.len, slot: place.slot, borrowed }))
    }

    /// Sends a message. Blocks while the socket is full. The runtime reads sent messages even if this process ends at
    /// once.
    ///
    /// # Errors
    /// [`IpcError::Gone`] if the runtime has ended.
    pub fn send(&self, message: &FromPlugin) -> Result<(), IpcError> {
        let mut buffer = [0; MAX_FRAMED];
        self.send_bytes(framing::encode_body(message, &mut buffer))
    }

    /// Sends bytes without a check: for plugins in other languages that encode messages themselves, and for tests of
    /// the runtime with invalid messages.
    ///
    /// # Errors
    /// As [`Self::send`].
    pub fn send_bytes(&self, body: &[u8]) -> Result<(), IpcError> {
        self.send_packet(PacketKind::Message, body)
    }

    fn send_packet(&self, kind: PacketKind, body: &[u8]) -> Result<(), IpcError> {
        loop {
            match socket::send(self.socket.as_fd(), kind, body, &[]) {
                Ok(()) => return Ok(()),
                Err(Errno::EINTR) => {}
                Err(Errno::EAGAIN) => {
                    socket::wait_writable(&self.socket, A_WHILE)
                        .map_err(IpcError::system("sending to the runtime"))?;
                }
                Err(Errno::EPIPE | Errno::ECONNRESET | Errno::ENOTCONN) => {
                    return Err(IpcError::Gone("runtime"));
                }
                Err(error) => return Err(IpcError::system("sending to the runtime")(error)),
            }
        }
    }
}

impl Inbox {
    /// Receives all waiting packets.
    fn fill(&mut self, socket: &OwnedFd) -> Result<(), IpcError> {
        let mut buffer = EMPTY;
        loop {
            let received = socket::receive_with_descriptors(socket.as_fd(), &mut buffer)
                .map_err(IpcError::system("receiving from the runtime"))?;
            match received {
                Received::Packet(PacketKind::Message, body, _) => {
                    self.messages.push_back(framing::decode_body(body));
                }
                Received::Packet(PacketKind::Slot, index, descriptors) => {
                    self.take_slot(index, descriptors)?;
                }
                // Possibly of a newer runtime. Everything that matters arrives as messages.
                Received::Packet(PacketKind::Hello, ..) | Received::Garbage => {}
                Received::Nothing => return Ok(()),
                Received::Closed => {
                    self.is_closed = true;
                    return Ok(());
                }
            }
        }
    }

    fn take_slot(&mut self, index: &[u8], descriptors: Vec<OwnedFd>) -> Result<(), IpcError> {
        let slot = index.first().and_then(|&index| self.slots.get_mut(usize::from(index)));
        if let (Some(slot), Some(descriptor)) = (slot, descriptors.into_iter().next()) {
            let map = map_read_only(descriptor).map_err(IpcError::system("mapping images"))?;
            *slot = Some(Arc::new(map));
        }
        Ok(())
    }
}

impl ObservationSample {
    /// Returns the bytes in the layout of [`vizflyt_protocol::packet::ObservationHeader`].
    pub fn bytes(&self) -> &[u8] {
        &self.memory[..self.len]
    }
}

impl Drop for ObservationSample {
    fn drop(&mut self) {
        self.borrowed.count.fetch_sub(1, Ordering::AcqRel);
        self.borrowed.board.give_back(self.slot);
    }
}

/// Compares the runtime's protocol version with the plugin's.
fn check_version(theirs: u16) -> Result<(), IpcError> {
    if theirs == PROTOCOL_VERSION {
        return Ok(());
    }
    let (them, me) = ("runtime", "plugin");
    let older = if theirs < PROTOCOL_VERSION { them } else { me };
    let error = PreambleError::Version { them, theirs, me, ours: PROTOCOL_VERSION, older };
    Err(IpcError::Version(error))
}

/// Timeout for the runtime's first packet. A running runtime sends it before or as soon as a plugin connects.
const HELLO_WITHIN: Duration = Duration::from_secs(5);
/// Maximum wait between checks for space in the socket.
const A_WHILE: Duration = Duration::from_secs(1);
