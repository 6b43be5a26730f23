//! MAVLink over a serial device, or over a pseudo-terminal that replaces one: the telemetry port of an autopilot.
//!
//! Bytes are sent at most at the baud rate, even if the kernel accepts more: a pseudo-terminal has no speed, but tests
//! must show that a bridge keeps up with a real port.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::pty::openpty;
use nix::sys::termios::{BaudRate, SetArg, cfmakeraw, cfsetspeed, tcgetattr, tcsetattr};
use nix::unistd::ttyname;

/// Default baud rate of a telemetry port.
pub const DEFAULT_BAUD: u32 = 921_600;
/// Bits on the line per byte: start, eight, stop.
const BITS_PER_BYTE: f64 = 10.0;
/// Maximum number of queued bytes; packets that do not fit are dropped whole, as by ArduPilot. Twice the bytes of
/// 921600 baud in the tenth of a second that the driver may catch up.
const MAX_WAITING: usize = 18 * 1024;
/// Time for which an idle line may send a burst [s]: the FIFO of a UART and a few ticks.
const BURST_S: f64 = 0.005;
/// Retry interval of a device that does not exist or was disconnected.
const RETRY: Duration = Duration::from_millis(250);

/// One end of a serial line.
pub struct SerialPort {
    path: PathBuf,
    baud: u32,
    line: Option<File>,
    /// Own pseudo-terminal, kept open so that a client that leaves does not hang up the line.
    made: Option<PseudoTerminal>,
    waiting: Vec<u8>,
    /// Number of bytes that may be sent now.
    allowance: f64,
    counted: Instant,
    retry_at: Instant,
    /// Whether a missing device was already reported.
    is_reported: bool,
    dropped: u64,
}

/// Pseudo-terminal created by this program.
struct PseudoTerminal {
    _client: OwnedFd,
    link: PathBuf,
    target: PathBuf,
}

impl Drop for PseudoTerminal {
    fn drop(&mut self) {
        // Only if the link is unchanged: another simulator may have replaced it.
        if std::fs::read_link(&self.link).is_ok_and(|target| target == self.target) {
            let _ = std::fs::remove_file(&self.link);
        }
    }
}

impl SerialPort {
    /// Opens the device at `path`; retries if it does not exist yet.
    pub fn open(path: &Path, baud: u32) -> Self {
        let mut port = Self::new(path, baud);
        port.reopen();
        port
    }

    /// Creates a pseudo-terminal and a symbolic link to it at `path`; an existing link is replaced.
    ///
    /// # Errors
    /// Returns the error of the operating system; `AlreadyExists` if the name belongs to something else than a symbolic
    /// link.
    pub fn make(path: &Path, baud: u32) -> io::Result<Self> {
        let ends = openpty(None, None)?;
        set_raw(&ends.slave, None)?;
        let target = ttyname(&ends.slave)?;
        let flags = OFlag::from_bits_retain(fcntl(&ends.master, FcntlArg::F_GETFL)?);
        fcntl(&ends.master, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK))?;
        if path.is_symlink() {
            std::fs::remove_file(path)?;
        }
        std::os::unix::fs::symlink(&target, path)?;
        let mut port = Self::new(path, baud);
        port.made = Some(PseudoTerminal { _client: ends.slave, link: path.to_owned(), target });
        port.line = Some(File::from(ends.master));
        Ok(port)
    }

    fn new(path: &Path, baud: u32) -> Self {
        let now = Instant::now();
        Self {
            path: path.to_owned(),
            baud,
            line: None,
            made: None,
            waiting: Vec::new(),
            allowance: 0.0,
            counted: now,
            retry_at: now,
            is_reported: false,
            dropped: 0,
        }
    }

    /// Returns the path of the line.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of dropped packets.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Passes received bytes to `sink`, and sends queued ones.
    pub fn receive(&mut self, mut sink: impl FnMut(&[u8])) {
        if self.line.is_none() && Instant::now() >= self.retry_at {
            self.reopen();
        }
        self.flush();
        let Some(line) = &mut self.line else { return };
        let mut buffer = [0; 2048];
        for _ in 0..64 {
            match line.read(&mut buffer) {
                Ok(0) => return self.hang_up(),
                Ok(length) => sink(&buffer[..length]),
                Err(error) if error.kind() == ErrorKind::WouldBlock => return,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return self.hang_up(),
            }
        }
    }

    /// Queues one packet, or drops it whole.
    pub fn send(&mut self, packet: &[u8]) {
        if self.line.is_none() || self.waiting.len() + packet.len() > MAX_WAITING {
            self.dropped += 1;
            return;
        }
        self.waiting.extend_from_slice(packet);
        self.flush();
    }

    fn flush(&mut self) {
        let now = Instant::now();
        let bytes_per_s = f64::from(self.baud) / BITS_PER_BYTE;
        let earned = now.duration_since(self.counted).as_secs_f64() * bytes_per_s;
        self.counted = now;
        self.allowance += earned;
        let Some(line) = &mut self.line else { return };
        let mut sent = 0;
        let gone = loop {
            let most = (self.waiting.len() - sent).min(self.allowance as usize);
            if most == 0 {
                break false;
            }
            match line.write(&self.waiting[sent..sent + most]) {
                Ok(0) => break true,
                Ok(length) => {
                    sent += length;
                    self.allowance -= length as f64;
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => break false,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => break true,
            }
        };
        self.waiting.drain(..sent);
        // An idle line does not accumulate its allowance.
        self.allowance = self.allowance.min(bytes_per_s * BURST_S);
        if gone {
            self.hang_up();
        }
    }

    fn hang_up(&mut self) {
        // An own pseudo-terminal has no device that could disconnect.
        if self.made.is_none() {
            tracing::warn!(
                "simulator: {} was disconnected; waiting for it to return",
                self.path.display()
            );
            self.line = None;
            self.waiting.clear();
            self.retry_at = Instant::now() + RETRY;
        }
    }

    fn reopen(&mut self) {
        match open_device(&self.path, self.baud) {
            Ok(line) => {
                self.line = Some(line);
                self.is_reported = false;
            }
            Err(error) => {
                if !self.is_reported {
                    tracing::warn!(
                        "simulator: cannot open {}: {error}; retrying until it exists",
                        self.path.display()
                    );
                    self.is_reported = true;
                }
                self.retry_at = Instant::now() + RETRY;
            }
        }
    }
}

fn open_device(path: &Path, baud: u32) -> io::Result<File> {
    let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
    let line = OpenOptions::new().read(true).write(true).custom_flags(flags.bits()).open(path)?;
    set_raw(&line, baud_rate(baud))?;
    Ok(line)
}

/// Sets raw mode, so that all bytes pass unchanged.
fn set_raw(line: &impl std::os::fd::AsFd, speed: Option<BaudRate>) -> io::Result<()> {
    let mut settings = tcgetattr(line)?;
    cfmakeraw(&mut settings);
    if let Some(speed) = speed {
        cfsetspeed(&mut settings, speed)?;
    }
    tcsetattr(line, SetArg::TCSANOW, &settings)?;
    Ok(())
}

/// Returns the operating system's constant for a baud rate of telemetry ports.
pub fn baud_rate(baud: u32) -> Option<BaudRate> {
    Some(match baud {
        57_600 => BaudRate::B57600,
        115_200 => BaudRate::B115200,
        230_400 => BaudRate::B230400,
        460_800 => BaudRate::B460800,
        500_000 => BaudRate::B500000,
        921_600 => BaudRate::B921600,
        1_000_000 => BaudRate::B1000000,
        1_500_000 => BaudRate::B1500000,
        2_000_000 => BaudRate::B2000000,
        3_000_000 => BaudRate::B3000000,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Longer than any machine needs; no result depends on it.
    const PATIENCE: Duration = Duration::from_secs(30);

    /// Runs both ends until `done`.
    fn until(mut done: impl FnMut() -> bool) {
        let end = Instant::now() + PATIENCE;
        while !done() {
            assert!(Instant::now() < end, "timeout");
            std::thread::yield_now();
        }
    }

    fn read(port: &mut SerialPort, into: &mut Vec<u8>) {
        port.receive(|bytes| into.extend_from_slice(bytes));
    }

    #[test]
    fn passes_every_byte_in_both_directions_also_after_a_reconnect() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uart");
        let all: Vec<u8> = (0..=255).collect();
        let mut vehicle = SerialPort::make(&path, 3_000_000).unwrap();
        for _ in 0..2 {
            let mut client = SerialPort::open(&path, 3_000_000);
            let (mut down, mut up) = (Vec::new(), Vec::new());
            vehicle.send(&all);
            client.send(&all);
            until(|| {
                read(&mut client, &mut down);
                read(&mut vehicle, &mut up);
                down.len() >= 256 && up.len() >= 256
            });
            assert_eq!((&down, &up), (&all, &all));
        }
        drop(vehicle);
        assert!(!path.is_symlink(), "the link must be removed");
    }

    #[test]
    fn waits_for_a_disconnected_device() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uart");
        // Not there yet: packets are dropped and counted.
        let mut vehicle = SerialPort::open(&path, 921_600);
        vehicle.send(b"lost");
        assert_eq!(vehicle.dropped(), 1);
        for _ in 0..2 {
            let mut bridge = SerialPort::make(&path, 921_600).unwrap();
            let mut received = Vec::new();
            until(|| {
                vehicle.receive(|_| {});
                vehicle.send(b"here");
                read(&mut bridge, &mut received);
                !received.is_empty()
            });
            drop(bridge);
            until(|| {
                vehicle.receive(|_| {});
                vehicle.line.is_none()
            });
        }
    }

    #[test]
    fn respects_the_baud_rate_and_drops_whole_packets() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uart");
        let mut vehicle = SerialPort::make(&path, 57_600).unwrap();
        let mut client = SerialPort::open(&path, 57_600);
        let (start, packet) = (Instant::now(), [7; 200]);
        let sent = 100;
        for _ in 0..sent {
            vehicle.send(&packet);
        }
        let kept = sent - vehicle.dropped() as usize;
        assert!(kept >= MAX_WAITING / 200 && kept < sent, "{kept} of {sent} kept");
        // A tenth of a second of data; on a slow machine it only takes longer.
        let mut received = Vec::new();
        until(|| {
            vehicle.receive(|_| {});
            read(&mut client, &mut received);
            received.len() >= 600
        });
        let least_s = (received.len() as f64 - 5_760.0 * BURST_S) / 5_760.0 - 1e-3;
        assert!(start.elapsed().as_secs_f64() >= least_s, "{} bytes", received.len());
    }

    #[test]
    fn does_not_overwrite_a_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        std::fs::write(&path, "precious").unwrap();
        assert!(SerialPort::make(&path, 57_600).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "precious");
    }
}
