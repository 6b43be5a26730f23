//! MAVLink over a serial device, or over a pseudo-terminal that stands in for one: what an
//! autopilot's telemetry port is to a bridge.
//!
//! Bytes leave no faster than the baud rate allows, whatever the kernel would take: a
//! pseudo-terminal has no speed of its own, and a bridge must be seen to keep up with a real one.

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

/// Baud rate of a telemetry port where none is given.
pub const DEFAULT_BAUD: u32 = 921_600;
/// Bits on the line per byte: start, eight, stop.
const BITS_PER_BYTE: f64 = 10.0;
/// Bytes that wait for the line at most; a packet that does not fit is dropped whole, as by
/// ArduPilot. Twice what 921600 baud carries in the tenth of a second that the driver catches up
/// at once. [bytes]
const MAX_WAITING: usize = 18 * 1024;
/// A line that was idle may send this much at once: the FIFO of a UART and some ticks. [s]
const BURST_S: f64 = 0.005;
/// A device that is not there, or gone, is tried again after this.
const RETRY: Duration = Duration::from_millis(250);

/// One end of a serial line.
pub struct SerialPort {
    path: PathBuf,
    baud: u32,
    line: Option<File>,
    /// Ours to keep open, so that a client that leaves does not hang up the line.
    made: Option<PseudoTerminal>,
    waiting: Vec<u8>,
    /// Bytes that may leave now.
    allowance: f64,
    counted: Instant,
    retry_at: Instant,
    /// A device that is not there is reported once.
    is_reported: bool,
    dropped: u64,
}

/// A pseudo-terminal made by us.
struct PseudoTerminal {
    _client: OwnedFd,
    link: PathBuf,
    target: PathBuf,
}

impl Drop for PseudoTerminal {
    fn drop(&mut self) {
        // Only if it is still ours: another simulator may have taken the name over.
        if std::fs::read_link(&self.link).is_ok_and(|target| target == self.target) {
            let _ = std::fs::remove_file(&self.link);
        }
    }
}

impl SerialPort {
    /// Opens the device at `path`; one that is not there yet is waited for.
    pub fn open(path: &Path, baud: u32) -> Self {
        let mut port = Self::new(path, baud);
        port.reopen();
        port
    }

    /// Makes a pseudo-terminal and a symbolic link to it at `path`; an older link there is replaced.
    ///
    /// # Errors
    /// Returns the operating system's refusal; `AlreadyExists` if something that is no symbolic
    /// link has the name.
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

    /// Returns where the line is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns packets dropped because the line could not take them.
    pub fn dropped(&self) -> u64 {
        self.dropped
    }

    /// Hands what has come to `sink`, and sends what waits.
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

    /// Sends one packet, or drops it whole.
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
        // What an idle line did not use is gone.
        self.allowance = self.allowance.min(bytes_per_s * BURST_S);
        if gone {
            self.hang_up();
        }
    }

    fn hang_up(&mut self) {
        // A pseudo-terminal of our own has no other end to lose.
        if self.made.is_none() {
            tracing::warn!("simulator: {} hung up; waiting for it", self.path.display());
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
                        "simulator: cannot open {}: {error}; trying again until it is there",
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

/// Lets every byte through as it is.
fn set_raw(line: &impl std::os::fd::AsFd, speed: Option<BaudRate>) -> io::Result<()> {
    let mut settings = tcgetattr(line)?;
    cfmakeraw(&mut settings);
    if let Some(speed) = speed {
        cfsetspeed(&mut settings, speed)?;
    }
    tcsetattr(line, SetArg::TCSANOW, &settings)?;
    Ok(())
}

/// Returns the operating system's name of a baud rate that telemetry ports use.
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

    /// Long enough for any machine: nothing here depends on how long it takes.
    const PATIENCE: Duration = Duration::from_secs(30);

    /// Turns both ends until `done`.
    fn until(mut done: impl FnMut() -> bool) {
        let end = Instant::now() + PATIENCE;
        while !done() {
            assert!(Instant::now() < end, "nothing came");
            std::thread::yield_now();
        }
    }

    fn read(port: &mut SerialPort, into: &mut Vec<u8>) {
        port.receive(|bytes| into.extend_from_slice(bytes));
    }

    #[test]
    fn every_byte_passes_both_ways_and_a_client_may_come_back() {
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
        assert!(!path.is_symlink(), "the link goes with its maker");
    }

    #[test]
    fn a_device_that_hangs_up_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("uart");
        // Not there yet: what is sent is lost, and counted.
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
    fn the_line_is_no_faster_than_its_baud_rate_and_drops_whole_packets() {
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
        // A tenth of a second's worth: it cannot come sooner, however slow the machine.
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
    fn a_file_is_not_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notes.txt");
        std::fs::write(&path, "precious").unwrap();
        assert!(SerialPort::make(&path, 57_600).is_err());
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "precious");
    }
}
