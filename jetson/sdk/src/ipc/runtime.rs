//! The runtime's end: writes observations, sends messages, reads replies.

use std::ffi::OsString;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use nix::errno::Errno;
use nix::sys::eventfd::{EfdFlags, EventFd};
use nix::sys::socket::{AddressFamily, SockFlag, SockType, socketpair};
use vizflyt_protocol::PROTOCOL_VERSION;
use vizflyt_protocol::messages::{FromPlugin, ToPlugin};
use vizflyt_protocol::packet::framing::{self, FramingError, MAX_FRAMED};

use super::board::{Board, Place};
use super::offer::{Listener, Offer};
use super::sealed::{WrittenMemory, let_inherit};
use super::socket::{self, EMPTY, PacketKind, Received};
use super::{IpcError, SERVICE_OPTION, SLOTS};

/// The runtime's end. All calls return at once, but for [`Self::wait`]; a plugin that hangs never blocks them.
#[derive(Debug)]
pub struct RuntimeEnd {
    slots: Arc<Mutex<Slots>>,
    connection: Mutex<Option<Arc<Connection>>>,
    /// Where a plugin that a person starts connects.
    listener: Mutex<Option<Listener>>,
    connections: AtomicU64,
}

/// Memory for one observation, to be written and then published. Dropped unpublished, it can be
/// lent again.
#[derive(Debug)]
pub struct LoanedObservation {
    slot: Option<Slot>,
    len: usize,
    slots: Arc<Mutex<Slots>>,
}

/// The plugin's end of the socket, to be handed to its process.
#[derive(Debug)]
pub struct PluginSocket(OwnedFd);

/// The runtime's side of one plugin.
#[derive(Debug)]
struct Connection {
    socket: OwnedFd,
    board: Board,
    bell: EventFd,
    /// The plugin has said that it is complete.
    attached: AtomicBool,
    /// The plugin has closed its end.
    closed: AtomicBool,
    /// Held while a packet is looked at and taken.
    reading: Mutex<()>,
    /// Counts connections.
    number: u64,
}

/// Memory for observations; each slot is in one place only.
#[derive(Debug)]
struct Slots {
    free: heapless::Vec<Slot, SLOTS>,
    /// Published: newest, or borrowed by the plugin.
    published: [Option<Slot>; SLOTS],
    made: usize,
    observation_len: usize,
}

#[derive(Debug)]
struct Slot {
    index: usize,
    memory: WrittenMemory,
    /// The connection whose plugin has its descriptor.
    known_to: Option<u64>,
}

impl RuntimeEnd {
    /// Makes an end that no plugin has attached to, for observations of `observation_len` bytes; larger ones are
    /// possible.
    pub fn new(observation_len: usize) -> Self {
        let slots = Slots {
            free: heapless::Vec::new(),
            published: Default::default(),
            made: 0,
            observation_len,
        };
        Self {
            slots: Arc::new(Mutex::new(slots)),
            connection: Mutex::default(),
            listener: Mutex::default(),
            connections: AtomicU64::default(),
        }
    }

    /// Connects the next plugin, in place of the one before.
    ///
    /// # Errors
    /// [`IpcError::System`], as when too many files are open.
    pub fn connect(&self) -> Result<PluginSocket, IpcError> {
        let flags = SockFlag::SOCK_CLOEXEC;
        let (ours, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, flags)
            .map_err(IpcError::system("making a socket"))?;
        self.greet(ours)?;
        Ok(PluginSocket(theirs))
    }

    /// Offers to be found by a plugin that a person of the same user starts.
    ///
    /// # Errors
    /// [`IpcError::System`] if the socket cannot be made, or its folder is another user's.
    pub fn offer(&self) -> Result<Offer, IpcError> {
        self.listen(true)
    }

    /// As [`Self::offer`], for a plugin that is told the service: it is not among [`offers`](super::offers).
    ///
    /// # Errors
    /// As [`Self::offer`].
    pub fn offer_unlisted(&self) -> Result<Offer, IpcError> {
        self.listen(false)
    }

    fn listen(&self, listed: bool) -> Result<Offer, IpcError> {
        let (offer, listener) =
            Offer::make(listed).map_err(IpcError::system("waiting for a plugin"))?;
        *lock(&self.listener) = Some(listener);
        Ok(offer)
    }

    /// Whether a plugin is attached: messages reach it.
    pub fn plugin_attached(&self) -> bool {
        self.accept();
        let Some(connection) = self.connection() else { return false };
        if !connection.is_attached() {
            let _reading = lock(&connection.reading);
            if let Ok(Received::Packet(PacketKind::Hello, ..)) =
                socket::peek(connection.socket.as_fd(), &mut [0])
            {
                let _ = connection.next();
            }
        }
        connection.is_attached() && !connection.has_closed()
    }

    /// Sends a message.
    ///
    /// # Errors
    /// [`IpcError::QueueFull`] if the plugin has left so many unread that it must be hung, [`IpcError::Gone`] if there
    /// is none.
    pub fn send(&self, message: &ToPlugin) -> Result<(), IpcError> {
        let connection = self.connection().ok_or(IpcError::Gone("plugin"))?;
        let mut buffer = [0; MAX_FRAMED];
        connection.send(PacketKind::Message, framing::encode_body(message, &mut buffer), &[])
    }

    /// Lends memory for one observation of `len` bytes: zeros, aligned to 64. More than ever before takes longer
    /// once.
    ///
    /// # Errors
    /// [`IpcError::NoSlot`] if two are lent already, [`IpcError::System`] if there is not so much memory.
    pub fn loan(&self, len: usize) -> Result<LoanedObservation, IpcError> {
        let mut slots = lock(&self.slots);
        if let Some(connection) = self.connection() {
            for index in connection.board.returned() {
                slots.reclaim(index);
            }
        }
        let slot = slots.take(len)?;
        drop(slots);
        let mut loan = LoanedObservation { slot: Some(slot), len, slots: Arc::clone(&self.slots) };
        loan.memory().fill(0);
        Ok(loan)
    }

    /// Publishes an observation and rings the plugin's bell; the one before is replaced if nobody has taken it. Without a
    /// plugin it is dropped.
    ///
    /// # Errors
    /// [`IpcError::QueueFull`] if the plugin does not read, so that it cannot be told of new memory.
    pub fn publish(&self, mut observation: LoanedObservation) -> Result<(), IpcError> {
        let shared = Arc::clone(&self.slots);
        let mut slots = lock(&shared);
        let Some(connection) = self.connection() else {
            slots.free.extend(observation.slot.take());
            return Ok(());
        };
        let Some(slot) = &mut observation.slot else { return Ok(()) };
        let place = Place { slot: slot.index, len: observation.len };
        if slot.known_to != Some(connection.number) {
            let descriptor = slot.memory.as_fd().as_raw_fd();
            if let Err(error) =
                connection.send(PacketKind::Slot, &[slot.index as u8], &[descriptor])
            {
                slots.free.extend(observation.slot.take());
                return if matches!(error, IpcError::Gone(_)) { Ok(()) } else { Err(error) };
            }
            slot.known_to = Some(connection.number);
        }
        slots.published[place.slot] = observation.slot.take();
        if let Some(unseen) = connection.board.post(place).filter(|old| old.slot != place.slot) {
            slots.reclaim(unseen.slot);
        }
        drop(slots);
        // Full only after 2^64 - 2 of them.
        let _ = connection.bell.write(1);
        Ok(())
    }

    /// Waits until the plugin sends something, `timeout` at most; returns whether it did.
    ///
    /// # Errors
    /// [`IpcError::System`].
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        self.accept();
        let Some(connection) = self.connection().filter(|connection| !connection.has_closed())
        else {
            // Until the next one connects.
            std::thread::sleep(timeout.min(NOBODY_THERE));
            return Ok(false);
        };
        socket::wait_readable(&[connection.socket.as_fd()], timeout)
            .map_err(IpcError::system("waiting for the plugin"))
    }

    /// Takes the plugin's next message, if there is one.
    ///
    /// # Errors
    /// [`IpcError::Message`] for one that does not decode; the next can still be read.
    pub fn receive(&self) -> Result<Option<FromPlugin>, IpcError> {
        let Some(connection) = self.connection() else { return Ok(None) };
        let _reading = lock(&connection.reading);
        connection.next()
    }

    /// Forgets a plugin that has ended, and takes back what it had borrowed. Call after each exit.
    pub fn clean_up(&self) {
        let mut slots = lock(&self.slots);
        *lock(&self.connection) = None;
        slots.reclaim_all();
    }

    fn connection(&self) -> Option<Arc<Connection>> {
        lock(&self.connection).clone()
    }

    /// Accepts a plugin that a person has started, if there is none yet.
    fn accept(&self) {
        let mut listener = lock(&self.listener);
        let Some(waiting) = &mut *listener else { return };
        if self.connection().is_some_and(|connection| !connection.has_closed()) {
            return;
        }
        if let Some(socket) = waiting.accept() {
            // Refused, it reads that nobody is there, and the person tries again.
            let _ = self.greet(socket);
        }
    }

    /// Makes a socket the plugin's, and hands over board and bell.
    fn greet(&self, socket: OwnedFd) -> Result<(), IpcError> {
        let flags = EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK;
        let bell =
            EventFd::from_value_and_flags(0, flags).map_err(IpcError::system("making a bell"))?;
        let connection = Connection {
            socket,
            board: Board::new().map_err(IpcError::system("making shared memory"))?,
            bell,
            attached: AtomicBool::default(),
            closed: AtomicBool::default(),
            reading: Mutex::default(),
            number: self.connections.fetch_add(1, Ordering::Relaxed),
        };
        let descriptors =
            [connection.board.as_fd().as_raw_fd(), connection.bell.as_fd().as_raw_fd()];
        connection.send(PacketKind::Hello, &PROTOCOL_VERSION.to_le_bytes(), &descriptors)?;
        let mut slots = lock(&self.slots);
        *lock(&self.connection) = Some(Arc::new(connection));
        slots.reclaim_all();
        Ok(())
    }
}

impl PluginSocket {
    /// Returns the option that tells the plugin's process where its end is.
    pub fn argument(&self) -> OsString {
        format!("{SERVICE_OPTION}=fd:{}", self.0.as_raw_fd()).into()
    }

    /// Has a child inherit it. Call it between fork and exec, in the child.
    ///
    /// # Errors
    /// The system's.
    pub fn let_inherit(&self) -> std::io::Result<()> {
        let_inherit(self.0.as_fd())
    }

    pub(super) fn into_inner(self) -> OwnedFd {
        self.0
    }
}

impl Connection {
    fn send(
        &self,
        kind: PacketKind,
        body: &[u8],
        descriptors: &[std::os::fd::RawFd],
    ) -> Result<(), IpcError> {
        match socket::send(self.socket.as_fd(), kind, body, descriptors) {
            Ok(()) => Ok(()),
            Err(Errno::EAGAIN) => Err(IpcError::QueueFull("plugin")),
            Err(Errno::EPIPE | Errno::ECONNRESET | Errno::ENOTCONN) => {
                Err(IpcError::Gone("plugin"))
            }
            Err(error) => Err(IpcError::system("sending to the plugin")(error)),
        }
    }

    /// Takes the next message; `reading` is held.
    fn next(&self) -> Result<Option<FromPlugin>, IpcError> {
        let mut buffer = EMPTY;
        loop {
            let received = socket::receive(self.socket.as_fd(), &mut buffer)
                .map_err(IpcError::system("receiving from the plugin"))?;
            match received {
                Received::Packet(PacketKind::Hello, ..) => {
                    self.attached.store(true, Ordering::Release);
                }
                Received::Packet(PacketKind::Message, body, _) => {
                    return Ok(Some(framing::decode_body(body)?));
                }
                Received::Packet(PacketKind::Slot, ..) | Received::Garbage => {
                    return Err(FramingError::Body(0).into());
                }
                Received::Nothing => return Ok(None),
                Received::Closed => {
                    self.closed.store(true, Ordering::Release);
                    return Ok(None);
                }
            }
        }
    }

    fn is_attached(&self) -> bool {
        self.attached.load(Ordering::Acquire)
    }

    /// Whether the plugin has closed its end, and left nothing to be read.
    fn has_closed(&self) -> bool {
        if matches!(socket::peek(self.socket.as_fd(), &mut [0]), Ok(Received::Closed)) {
            self.closed.store(true, Ordering::Release);
        }
        self.closed.load(Ordering::Acquire)
    }
}

impl Slots {
    /// Takes a slot with room for `len` bytes.
    fn take(&mut self, len: usize) -> Result<Slot, IpcError> {
        if let Some(fitting) = self.free.iter().position(|slot| slot.memory.len() >= len) {
            return Ok(self.free.swap_remove(fitting));
        }
        let memory = || {
            // Cameras may grow while flying; the memory follows in few steps.
            let len = len.max(self.observation_len).next_power_of_two().max(LEAST_SLOT);
            WrittenMemory::new(len).map_err(IpcError::system("making shared memory"))
        };
        if self.made < SLOTS {
            let slot = Slot { index: self.made, memory: memory()?, known_to: None };
            self.made += 1;
            return Ok(slot);
        }
        let memory = memory()?;
        let old = self.free.pop().ok_or(IpcError::NoSlot(SLOTS))?;
        Ok(Slot { index: old.index, memory, known_to: None })
    }

    /// Takes back what was published in slot `index`, if anything was.
    fn reclaim(&mut self, index: usize) {
        // Each slot is in one place, so there is room.
        self.free.extend(self.published[index].take());
    }

    /// Takes back all that was published.
    fn reclaim_all(&mut self) {
        (0..SLOTS).for_each(|index| self.reclaim(index));
    }
}

impl LoanedObservation {
    /// Returns what was written.
    pub fn bytes(&self) -> &[u8] {
        self.slot.as_ref().map_or(&[], |slot| &slot.memory.bytes()[..self.len])
    }

    /// Returns the memory to write into.
    pub fn memory(&mut self) -> &mut [u8] {
        self.slot.as_mut().map_or(&mut [], |slot| &mut slot.memory.bytes_mut()[..self.len])
    }
}

impl Drop for LoanedObservation {
    fn drop(&mut self) {
        if let Some(slot) = self.slot.take() {
            lock(&self.slots).free.extend([slot]);
        }
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Where no plugin is connected, one is looked for this often.
const NOBODY_THERE: Duration = Duration::from_millis(10);
/// A page. [bytes]
const LEAST_SLOT: usize = 4096;
