//! The runtime's end of the connection: writes observations, sends messages, reads replies.

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

/// The runtime's end of the connection. All calls except [`Self::wait`] return at once; a plugin that hangs never
/// blocks them.
#[derive(Debug)]
pub struct RuntimeEnd {
    slots: Arc<Mutex<Slots>>,
    connection: Mutex<Option<Arc<Connection>>>,
    /// Socket for plugins that are started by hand.
    listener: Mutex<Option<Listener>>,
    connections: AtomicU64,
}

/// Memory for one observation, to be written and then published. If it is dropped before, it can be lent again.
#[derive(Debug)]
pub struct LoanedObservation {
    slot: Option<Slot>,
    len: usize,
    slots: Arc<Mutex<Slots>>,
}

/// The plugin's end of the socket, to be passed to its process.
#[derive(Debug)]
pub struct PluginSocket(OwnedFd);

/// Connection to one plugin.
#[derive(Debug)]
struct Connection {
    socket: OwnedFd,
    board: Board,
    bell: EventFd,
    /// The plugin has replied to the first packet.
    attached: AtomicBool,
    /// The plugin has closed its end.
    closed: AtomicBool,
    /// Held while a packet is inspected and taken.
    reading: Mutex<()>,
    /// Number of the connection.
    number: u64,
}

/// Memory for observations. Each slot has exactly one owner.
#[derive(Debug)]
struct Slots {
    free: heapless::Vec<Slot, SLOTS>,
    /// Published slots: the newest, and those that the plugin has borrowed.
    published: [Option<Slot>; SLOTS],
    made: usize,
    observation_len: usize,
}

#[derive(Debug)]
struct Slot {
    index: usize,
    memory: WrittenMemory,
    /// Connection over which the memory's descriptor was sent.
    known_to: Option<u64>,
}

impl RuntimeEnd {
    /// Creates an end without a plugin, for observations of `observation_len` bytes. Larger observations are possible.
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

    /// Connects the next plugin and replaces the previous one.
    ///
    /// # Errors
    /// [`IpcError::System`], for example if too many files are open.
    pub fn connect(&self) -> Result<PluginSocket, IpcError> {
        let flags = SockFlag::SOCK_CLOEXEC;
        let (ours, theirs) = socketpair(AddressFamily::Unix, SockType::SeqPacket, None, flags)
            .map_err(IpcError::system("making a socket"))?;
        self.greet(ours)?;
        Ok(PluginSocket(theirs))
    }

    /// Offers a connection to plugins that the same user starts by hand.
    ///
    /// # Errors
    /// [`IpcError::System`] if the socket cannot be made, or its folder is another user's.
    pub fn offer(&self) -> Result<Offer, IpcError> {
        self.listen(true)
    }

    /// As [`Self::offer`], for a plugin that is started with the service's path. [`offers`](super::offers) does not
    /// list it.
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

    /// Returns whether a plugin is attached, so that messages reach it.
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
    /// [`IpcError::QueueFull`] if the socket is full of unread messages, because the plugin hangs; [`IpcError::Gone`]
    /// without a plugin.
    pub fn send(&self, message: &ToPlugin) -> Result<(), IpcError> {
        let connection = self.connection().ok_or(IpcError::Gone("plugin"))?;
        let mut buffer = [0; MAX_FRAMED];
        connection.send(PacketKind::Message, framing::encode_body(message, &mut buffer), &[])
    }

    /// Lends memory for one observation of `len` bytes: zeros, aligned to 64. The first request for a larger size takes
    /// longer, because memory is allocated.
    ///
    /// # Errors
    /// [`IpcError::NoSlot`] if two are lent already, [`IpcError::System`] if there is not enough memory.
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

    /// Publishes an observation and rings the plugin's bell. Replaces the previous one if the plugin has not taken it.
    /// Without a plugin, the observation is dropped.
    ///
    /// # Errors
    /// [`IpcError::QueueFull`] if the plugin does not read its messages, so that the descriptor of new memory cannot be
    /// sent.
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
        // Full only after 2^64 - 2 observations.
        let _ = connection.bell.write(1);
        Ok(())
    }

    /// Waits for a message of the plugin, at most `timeout`. Returns whether there is one.
    ///
    /// # Errors
    /// [`IpcError::System`].
    pub fn wait(&self, timeout: Duration) -> Result<bool, IpcError> {
        self.accept();
        let Some(connection) = self.connection().filter(|connection| !connection.has_closed())
        else {
            std::thread::sleep(timeout.min(NOBODY_THERE));
            return Ok(false);
        };
        socket::wait_readable(&[connection.socket.as_fd()], timeout)
            .map_err(IpcError::system("waiting for the plugin"))
    }

    /// Takes the next message of the plugin, if any.
    ///
    /// # Errors
    /// [`IpcError::Message`] for a message that does not decode. The next one can still be read.
    pub fn receive(&self) -> Result<Option<FromPlugin>, IpcError> {
        let Some(connection) = self.connection() else { return Ok(None) };
        let _reading = lock(&connection.reading);
        connection.next()
    }

    /// Disconnects a plugin that has ended, and reclaims its borrowed slots. Call it after each exit.
    pub fn clean_up(&self) {
        let mut slots = lock(&self.slots);
        *lock(&self.connection) = None;
        slots.reclaim_all();
    }

    fn connection(&self) -> Option<Arc<Connection>> {
        lock(&self.connection).clone()
    }

    /// Accepts a plugin that was started by hand, unless a plugin is connected.
    fn accept(&self) {
        let mut listener = lock(&self.listener);
        let Some(waiting) = &mut *listener else { return };
        if self.connection().is_some_and(|connection| !connection.has_closed()) {
            return;
        }
        if let Some(socket) = waiting.accept() {
            // If this fails, the plugin reports a missing runtime, and the user can retry.
            let _ = self.greet(socket);
        }
    }

    /// Uses a socket for the next plugin, and sends it board and bell.
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
    /// Returns the option that passes the number of the descriptor to the plugin's process.
    pub fn argument(&self) -> OsString {
        format!("{SERVICE_OPTION}=fd:{}", self.0.as_raw_fd()).into()
    }

    /// Lets a child process inherit the descriptor. Call it between fork and exec, in the child.
    ///
    /// # Errors
    /// Errors of the system.
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

    /// Takes the next message. The caller holds `reading`.
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

    /// Returns whether the plugin has closed its end and no unread message is left.
    fn has_closed(&self) -> bool {
        if matches!(socket::peek(self.socket.as_fd(), &mut [0]), Ok(Received::Closed)) {
            self.closed.store(true, Ordering::Release);
        }
        self.closed.load(Ordering::Acquire)
    }
}

impl Slots {
    /// Takes a slot with space for `len` bytes.
    fn take(&mut self, len: usize) -> Result<Slot, IpcError> {
        if let Some(fitting) = self.free.iter().position(|slot| slot.memory.len() >= len) {
            return Ok(self.free.swap_remove(fitting));
        }
        let memory = || {
            // Images may grow in flight. Powers of two limit the number of allocations.
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

    /// Reclaims the observation published in slot `index`, if any.
    fn reclaim(&mut self, index: usize) {
        // Each slot has one owner, so there is space.
        self.free.extend(self.published[index].take());
    }

    /// Reclaims all published observations.
    fn reclaim_all(&mut self) {
        (0..SLOTS).for_each(|index| self.reclaim(index));
    }
}

impl LoanedObservation {
    /// Returns the written bytes.
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

/// Maximum wait before the next check for a plugin, while none is connected.
const NOBODY_THERE: Duration = Duration::from_millis(10);
/// One page. [bytes]
const LEAST_SLOT: usize = 4096;
