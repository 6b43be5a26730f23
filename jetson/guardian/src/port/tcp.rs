//! MAVLink over TCP, as offered by a simulated ArduCopter (port 5760) and some bridges. A broken connection is made
//! again. If bytes cannot be sent in time, the connection is closed, because a partial packet would corrupt the stream.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::fd::OwnedFd;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

/// Maximum wait for bytes, so that the receiving thread notices the end of the flight.
const WAIT: Duration = Duration::from_millis(100);
/// Maximum time for which the control loop waits for space in the socket's buffer.
const SEND_WAIT: Duration = Duration::from_millis(20);
/// Connection timeout. On this host, a missing server is refused at once.
const CONNECT_WAIT: Duration = Duration::from_millis(500);

/// TCP transport with one connection at a time.
#[derive(Debug)]
pub(super) struct TcpPort {
    peer: Peer,
    stream: Mutex<Option<Arc<TcpStream>>>,
    changes: AtomicU32,
}

#[derive(Debug)]
enum Peer {
    Waits(TcpListener),
    Calls(SocketAddr),
}

impl TcpPort {
    pub(super) fn listen(local: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(local)?;
        listener.set_nonblocking(true)?;
        Ok(Self::adopt_listening(listener, None))
    }

    pub(super) fn connect(to: SocketAddr) -> Self {
        Self::adopt(to, None)
    }

    /// Returns a port over the listener and the connection of another one.
    pub(super) fn adopt_listening(listener: TcpListener, stream: Option<TcpStream>) -> Self {
        Self::new(Peer::Waits(listener), stream)
    }

    /// Returns a port over the connection of another one to `to`.
    pub(super) fn adopt(to: SocketAddr, stream: Option<TcpStream>) -> Self {
        Self::new(Peer::Calls(to), stream)
    }

    fn new(peer: Peer, stream: Option<TcpStream>) -> Self {
        Self { peer, stream: Mutex::new(stream.map(Arc::new)), changes: AtomicU32::new(0) }
    }

    /// Returns the listener, if there is one, and the connection, if there is one.
    pub(super) fn share(&self) -> io::Result<Vec<OwnedFd>> {
        let mut shared = Vec::new();
        if let Peer::Waits(listener) = &self.peer {
            shared.push(listener.try_clone()?.into());
        }
        if let Some(stream) = self.current() {
            shared.push(stream.try_clone()?.into());
        }
        Ok(shared)
    }

    pub(super) fn changes(&self) -> u32 {
        self.changes.load(Ordering::Relaxed)
    }

    pub(super) fn local(&self) -> io::Result<String> {
        match &self.peer {
            Peer::Waits(listener) => Ok(listener.local_addr()?.to_string()),
            Peer::Calls(to) => Ok(to.to_string()),
        }
    }

    fn current(&self) -> Option<Arc<TcpStream>> {
        self.stream.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, stream: Option<Arc<TcpStream>>) {
        *self.stream.lock().unwrap_or_else(PoisonError::into_inner) = stream;
        self.changes.fetch_add(1, Ordering::Relaxed);
    }

    /// Opens a connection, within [`CONNECT_WAIT`].
    fn open(&self) -> io::Result<Arc<TcpStream>> {
        let stream = match &self.peer {
            Peer::Waits(listener) => listener.accept()?.0,
            Peer::Calls(to) => TcpStream::connect_timeout(to, CONNECT_WAIT)?,
        };
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_read_timeout(Some(WAIT))?;
        stream.set_write_timeout(Some(SEND_WAIT))?;
        Ok(Arc::new(stream))
    }

    pub(super) fn receive(&self, buffer: &mut [u8]) -> Option<usize> {
        let Some(stream) = self.current() else {
            match self.open() {
                Ok(stream) => self.set(Some(stream)),
                Err(_) => thread::sleep(WAIT / 5),
            }
            return None;
        };
        match (&*stream).read(buffer) {
            Ok(len) if len > 0 => return Some(len),
            Err(error) if is_pause(&error) => {}
            Ok(_) | Err(_) => self.set(None),
        }
        None
    }

    pub(super) fn send(&self, bytes: &[u8]) {
        if let Some(stream) = self.current()
            && (&*stream).write_all(bytes).is_err()
        {
            self.set(None);
        }
    }
}

fn is_pause(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}
