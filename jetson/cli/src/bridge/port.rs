//! Serial port of the autopilot for an emulated bridge: a device, or a pseudo-terminal with the
//! timing of a line at its baud rate.

use std::fs::{File, OpenOptions};
use std::io::{ErrorKind, Read, Write};
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use nix::fcntl::{FcntlArg, OFlag, fcntl};
use nix::pty::openpty;
use nix::sys::termios::{SetArg, cfmakeraw, cfsetspeed, tcgetattr, tcsetattr};
use nix::unistd::ttyname;
use vizflyt_simulator::link::serial::baud_rate;

/// Location of the autopilot's port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Uart {
    /// New pseudo-terminal, with an optional symbolic link to it.
    Pty(Option<PathBuf>),
    /// Serial device.
    Device(PathBuf),
}

impl FromStr for Uart {
    type Err = std::convert::Infallible;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        Ok(match text.strip_prefix("pty") {
            Some("") => Self::Pty(None),
            Some(rest) if rest.starts_with(':') => Self::Pty(Some(rest[1..].into())),
            _ => Self::Device(text.into()),
        })
    }
}

/// Bytes that arrive at once: an ESP's UART collects this many before an interrupt. [bytes]
const CHUNK: usize = 64;
/// Bits on the line per byte: start bit, eight data bits, stop bit.
const BITS_PER_BYTE: u64 = 10;
/// A line that was busy until this long ago continues without a gap: a late wake-up of this process
/// is not a gap of the line.
const GAP: Duration = Duration::from_millis(2);

pub(crate) struct Port {
    line: File,
    path: PathBuf,
    /// Kept open, so that a client that disconnects does not hang up the line.
    _kept: Option<OwnedFd>,
    link: Option<(PathBuf, PathBuf)>,
    /// Duration of a byte on the line; zero if the device itself has the timing.
    byte: Duration,
    incoming: [u8; CHUNK],
    came: usize,
    /// End of the last chunk on the line.
    in_until: Instant,
    in_full: bool,
    outgoing: Vec<u8>,
    out_until: Instant,
}

impl Port {
    /// Opens the port.
    pub(crate) fn open(uart: &Uart, baud: u32) -> Result<Self> {
        match uart {
            Uart::Pty(link) => Self::make(link.as_deref(), baud),
            Uart::Device(path) => Self::device(path, baud),
        }
    }

    fn make(link: Option<&Path>, baud: u32) -> Result<Self> {
        let ends = openpty(None, None).context("bridge: cannot make a pseudo-terminal")?;
        raw(&ends.slave, None)?;
        let path = ttyname(&ends.slave).context("bridge: the pseudo-terminal has no name")?;
        let flags = OFlag::from_bits_retain(fcntl(&ends.master, FcntlArg::F_GETFL)?);
        fcntl(&ends.master, FcntlArg::F_SETFL(flags | OFlag::O_NONBLOCK))?;
        if let Some(link) = link {
            if link.is_symlink() {
                std::fs::remove_file(link)
                    .with_context(|| format!("bridge: cannot replace {}", link.display()))?;
            }
            std::os::unix::fs::symlink(&path, link).with_context(|| {
                format!("bridge: cannot make {}; is there a file of that name?", link.display())
            })?;
        }
        let byte = Duration::from_nanos(BITS_PER_BYTE * 1_000_000_000 / u64::from(baud));
        let named = link.map(|link| (link.to_owned(), path.clone()));
        Ok(Self::new(ends.master.into(), path, Some(ends.slave), named, byte))
    }

    fn device(path: &Path, baud: u32) -> Result<Self> {
        let flags = OFlag::O_NONBLOCK | OFlag::O_NOCTTY;
        let line = OpenOptions::new()
            .read(true)
            .write(true)
            .custom_flags(flags.bits())
            .open(path)
            .with_context(|| format!("bridge: cannot open {}", path.display()))?;
        raw(&line, Some(baud)).with_context(|| {
            format!("bridge: {} does not take {baud} baud; is it a serial port?", path.display())
        })?;
        Ok(Self::new(line, path.to_owned(), None, None, Duration::ZERO))
    }

    fn new(
        line: File,
        path: PathBuf,
        kept: Option<OwnedFd>,
        link: Option<(PathBuf, PathBuf)>,
        byte: Duration,
    ) -> Self {
        let now = Instant::now();
        Self {
            line,
            path,
            _kept: kept,
            link,
            byte,
            incoming: [0; CHUNK],
            came: 0,
            in_until: now,
            in_full: false,
            outgoing: Vec::new(),
            out_until: now,
        }
    }

    /// Returns the device path of the autopilot's end.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the file descriptor to wait for.
    pub(crate) fn as_fd(&self) -> BorrowedFd<'_> {
        self.line.as_fd()
    }

    /// Whether to wait for input: no bytes are on the line.
    pub(crate) fn wants_input(&self) -> bool {
        self.came == 0
    }

    /// Returns when the line finishes its current chunk or packet.
    pub(crate) fn due(&self) -> Option<Instant> {
        let arriving = (self.came > 0).then_some(self.in_until);
        let leaving = (!self.outgoing.is_empty()).then_some(self.out_until);
        [arriving, leaving].into_iter().flatten().min()
    }

    /// Passes the bytes that the line has carried by `now` to `sink`.
    pub(crate) fn receive(&mut self, now: Instant, mut sink: impl FnMut(&[u8])) -> Result<()> {
        // Bounded, so that a flood does not starve other work.
        for _ in 0..64 {
            if self.came == 0 {
                match self.line.read(&mut self.incoming) {
                    Ok(0) => anyhow::bail!("bridge: {} has hung up", self.path.display()),
                    Ok(len) => {
                        let goes_on = self.in_full && now.duration_since(self.in_until) < GAP;
                        let from = if goes_on { self.in_until } else { now };
                        self.came = len;
                        self.in_full = len == CHUNK;
                        self.in_until = from + self.byte * len as u32;
                    }
                    Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                    Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                    Err(error) => {
                        return Err(error).with_context(|| {
                            format!("bridge: cannot read {}", self.path.display())
                        });
                    }
                }
            }
            if self.in_until > now {
                return Ok(());
            }
            sink(&self.incoming[..self.came]);
            self.came = 0;
        }
        Ok(())
    }

    /// Releases a packet that the line has carried by `now`; returns whether the line is free.
    /// Without flow control, unread bytes are lost.
    pub(crate) fn is_free(&mut self, now: Instant) -> Result<bool> {
        if !self.outgoing.is_empty() {
            if self.out_until > now {
                return Ok(false);
            }
            match self.line.write(&self.outgoing) {
                Ok(_) => {}
                Err(error)
                    if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => {}
                Err(error) => {
                    return Err(error)
                        .with_context(|| format!("bridge: cannot write {}", self.path.display()));
                }
            }
            self.outgoing.clear();
        }
        Ok(true)
    }

    /// Puts a packet on the line, which must be free.
    pub(crate) fn send(&mut self, now: Instant, packet: &[u8]) {
        let goes_on = now.duration_since(self.out_until) < GAP / 10;
        let from = if goes_on { self.out_until } else { now };
        self.outgoing.extend_from_slice(packet);
        self.out_until = from + self.byte * packet.len() as u32;
    }
}

impl Drop for Port {
    fn drop(&mut self) {
        // Removed only if the link still points here: another bridge may use the name.
        if let Some((link, target)) = &self.link
            && std::fs::read_link(link).is_ok_and(|found| found == *target)
        {
            let _ = std::fs::remove_file(link);
        }
    }
}

/// Sets the line to raw mode, so that every byte passes unchanged.
fn raw(line: &impl AsFd, baud: Option<u32>) -> Result<()> {
    let mut settings = tcgetattr(line)?;
    cfmakeraw(&mut settings);
    if let Some(baud) = baud {
        let speed = baud_rate(baud)
            .with_context(|| format!("{baud} baud is not supported by this system"))?;
        cfsetspeed(&mut settings, speed)?;
    }
    tcsetattr(line, SetArg::TCSANOW, &settings)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parses_uarts() {
        let check = |text: &str, expected: Uart| assert_eq!(text.parse(), Ok(expected), "{text}");
        check("pty", Uart::Pty(None));
        check("pty:/tmp/uart", Uart::Pty(Some("/tmp/uart".into())));
        check("/dev/ttyUSB0", Uart::Device("/dev/ttyUSB0".into()));
        check("ptyx", Uart::Device("ptyx".into()));
    }

    /// On a simulated clock: the bytes that a line of 57600 baud carries, and when.
    #[test]
    fn has_the_timing_of_a_serial_line() {
        let mut port = Port::open(&Uart::Pty(None), 57_600).unwrap();
        let mut autopilot = OpenOptions::new().read(true).write(true).open(port.path()).unwrap();
        autopilot.write_all(&[7; 100]).unwrap();
        let start = Instant::now() + Duration::from_secs(1);
        let mut received = 0;
        let mut arrivals = Vec::new();
        for step in 0..400u32 {
            let now = start + Duration::from_micros(100) * step;
            port.receive(now, |bytes| {
                received += bytes.len();
                arrivals.push((step, bytes.len()));
            })
            .unwrap();
        }
        assert_eq!(received, 100);
        // 64 bytes take 11.1 ms, the other 36 another 6.25 ms.
        assert_eq!(arrivals, [(112, 64), (174, 36)]);

        assert!(port.is_free(start).unwrap());
        port.send(start, &[9; 57]);
        assert!(!port.is_free(start + Duration::from_micros(9_800)).unwrap());
        assert!(port.is_free(start + Duration::from_micros(9_900)).unwrap());
        let mut sent = [0; 57];
        autopilot.read_exact(&mut sent).unwrap();
        assert_eq!(sent, [9; 57]);
    }
}
