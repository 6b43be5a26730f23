//! MAVLink over a serial line: raw bytes, 8N1. An unplugged device is reopened when it is back. Bytes that the line
//! cannot accept at once are queued. If the queue is full, whole packets are dropped, as datagrams would be.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::Duration;

use nix::fcntl::{Flock, FlockArg};
use nix::libc::{O_NOCTTY, O_NONBLOCK};
use nix::poll::{PollFd, PollFlags, poll};
use nix::sys::termios::{
    BaudRate, ControlFlags, FlushArg, SetArg, cfmakeraw, cfsetspeed, tcflush, tcgetattr, tcsetattr,
};

/// Maximum wait for bytes. [ms]
const WAIT_MS: u8 = 100;
/// Size of the send queue: 20 ms at 921600 baud. Older setpoints are useless. [bytes]
const BACKLOG: usize = 2048;

#[derive(Debug)]
pub(super) struct SerialPort {
    path: PathBuf,
    baud: BaudRate,
    flow: bool,
    /// Locked: if two programs read, each would get only some of the bytes.
    file: Mutex<Option<Arc<Flock<File>>>>,
    backlog: Mutex<Vec<u8>>,
    changes: AtomicU32,
}

/// Returns the system's constant for a baud rate; `None` if it is not supported.
pub(super) fn speed(baud: u32) -> Option<BaudRate> {
    const SPEEDS: [(u32, BaudRate); 14] = [
        (9_600, BaudRate::B9600),
        (19_200, BaudRate::B19200),
        (38_400, BaudRate::B38400),
        (57_600, BaudRate::B57600),
        (115_200, BaudRate::B115200),
        (230_400, BaudRate::B230400),
        (460_800, BaudRate::B460800),
        (500_000, BaudRate::B500000),
        (921_600, BaudRate::B921600),
        (1_000_000, BaudRate::B1000000),
        (1_500_000, BaudRate::B1500000),
        (2_000_000, BaudRate::B2000000),
        (3_000_000, BaudRate::B3000000),
        (4_000_000, BaudRate::B4000000),
    ];
    SPEEDS.iter().find(|(known, _)| *known == baud).map(|&(_, speed)| speed)
}

impl SerialPort {
    pub(super) fn open(path: &Path, baud: u32, flow: bool) -> io::Result<Self> {
        let speed = speed(baud).ok_or(ErrorKind::InvalidInput)?;
        Ok(Self::new(path, speed, flow, Some(open(path, speed, flow)?)))
    }

    /// Returns a port over the device that another one has opened; without a `file`, the device is opened again.
    pub(super) fn adopt(
        path: &Path,
        baud: u32,
        flow: bool,
        file: Option<File>,
    ) -> io::Result<Self> {
        let speed = speed(baud).ok_or(ErrorKind::InvalidInput)?;
        // Both descriptors share one lock.
        let file = file.map(lock).transpose()?;
        Ok(Self::new(path, speed, flow, file))
    }

    fn new(path: &Path, baud: BaudRate, flow: bool, file: Option<Flock<File>>) -> Self {
        Self {
            path: path.to_owned(),
            baud,
            flow,
            file: Mutex::new(file.map(Arc::new)),
            backlog: Mutex::default(),
            changes: AtomicU32::new(0),
        }
    }

    /// Returns the device, if it is open.
    pub(super) fn share(&self) -> io::Result<Vec<OwnedFd>> {
        let clone = |file: Arc<Flock<File>>| Ok(file.try_clone()?.into());
        self.current().map(clone).into_iter().collect()
    }

    pub(super) fn changes(&self) -> u32 {
        self.changes.load(Ordering::Relaxed)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    fn current(&self) -> Option<Arc<Flock<File>>> {
        self.file.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn set(&self, file: Option<Arc<Flock<File>>>) {
        *self.file.lock().unwrap_or_else(PoisonError::into_inner) = file;
        self.changes.fetch_add(1, Ordering::Relaxed);
    }

    pub(super) fn receive(&self, buffer: &mut [u8]) -> Option<usize> {
        let Some(file) = self.current() else {
            match open(&self.path, self.baud, self.flow) {
                Ok(file) => {
                    self.backlog.lock().unwrap_or_else(PoisonError::into_inner).clear();
                    self.set(Some(Arc::new(file)));
                }
                Err(_) => thread::sleep(Duration::from_millis(u64::from(WAIT_MS))),
            }
            return None;
        };
        let mut fds = [PollFd::new(file.as_fd(), PollFlags::POLLIN)];
        // Interrupted or timed out: the caller retries.
        if !matches!(poll(&mut fds, WAIT_MS), Ok(ready) if ready > 0) {
            return None;
        }
        match (&**file).read(buffer) {
            Ok(len) if len > 0 => return Some(len),
            Err(error)
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
            // Unplugged.
            Ok(_) | Err(_) => self.set(None),
        }
        None
    }

    pub(super) fn send(&self, bytes: &[u8]) {
        let Some(file) = self.current() else { return };
        let mut backlog = self.backlog.lock().unwrap_or_else(PoisonError::into_inner);
        if backlog.len() + bytes.len() <= BACKLOG {
            backlog.extend_from_slice(bytes);
        }
        while !backlog.is_empty() {
            match (&**file).write(&backlog) {
                Ok(len) if len > 0 => {
                    backlog.drain(..len);
                }
                // Line busy or device gone; the receiving thread detects the latter.
                _ => break,
            }
        }
    }
}

fn open(path: &Path, baud: BaudRate, flow: bool) -> io::Result<Flock<File>> {
    let file =
        OpenOptions::new().read(true).write(true).custom_flags(O_NOCTTY | O_NONBLOCK).open(path)?;
    let file = lock(file)?;
    let mut settings = tcgetattr(&*file)?;
    cfmakeraw(&mut settings);
    settings.control_flags |= ControlFlags::CLOCAL | ControlFlags::CREAD;
    settings.control_flags.set(ControlFlags::CRTSCTS, flow);
    cfsetspeed(&mut settings, baud)?;
    tcsetattr(&*file, SetArg::TCSANOW, &settings)?;
    tcflush(&*file, FlushArg::TCIOFLUSH)?;
    Ok(file)
}

fn lock(file: File) -> io::Result<Flock<File>> {
    Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|_| ErrorKind::AddrInUse.into())
}
