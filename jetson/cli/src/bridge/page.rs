//! Web page of the emulated bridge, for status, settings and firmware. Serves one browser at a
//! time, as a chip does, without blocking.

use std::io::{ErrorKind, Read, Write};
use std::net::{SocketAddr, SocketAddrV4, TcpListener, TcpStream};
use std::os::fd::{AsFd, BorrowedFd};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use vizflyt_bridge::Bridge;
use vizflyt_bridge::http::{Progress, Request};
use vizflyt_bridge::page;
use vizflyt_bridge::settings::Key;
use vizflyt_bridge::update::{Fault, Slots, Target, Updater, Wanted};
use vizflyt_protocol::time::HostTime;

use super::flash::FileFlash;

/// Server of the page.
pub(crate) struct Page {
    listener: TcpListener,
    visitor: Option<Visitor>,
    halves: Option<Halves>,
}

/// A connected browser or firmware upload.
struct Visitor {
    stream: TcpStream,
    heard_at: Instant,
    request: Request,
    updater: Option<Updater>,
    answer: Option<Vec<u8>>,
    /// The reply has been sent; remaining input is read, so that a reset does not discard the
    /// reply.
    answered: bool,
    restart: bool,
}

/// Spare half of the flash and the accepted firmware. An upload is verified as on a chip; this
/// computer cannot run it, so that only its build number takes effect.
struct Halves {
    key: Key,
    build: u32,
    spare: FileFlash,
}

impl Slots for Halves {
    type Spare = FileFlash;

    fn spare(&mut self) -> &mut FileFlash {
        &mut self.spare
    }

    fn start_spare(&mut self) -> bool {
        true
    }
}

impl Page {
    /// Listens at `address`; accepts firmware if `key`, the public key of its signature, is given.
    pub(crate) fn open(address: SocketAddrV4, key: Option<Key>) -> Result<Self> {
        let listener = TcpListener::bind(address)
            .with_context(|| format!("bridge: cannot show its page at {address}; is it in use?"))?;
        listener.set_nonblocking(true)?;
        let halves = key.map(|key| Halves { key, build: 0, spare: FileFlash::spare(HALF) });
        Ok(Self { listener, visitor: None, halves })
    }

    pub(crate) fn address(&self) -> std::io::Result<SocketAddr> {
        self.listener.local_addr()
    }

    /// Serves the current visitor. Returns true if the bridge must restart with new firmware.
    pub(crate) fn turn(&mut self, bridge: &mut Bridge, at: HostTime, now: Instant) -> bool {
        if self.visitor.is_none()
            && let Ok((stream, _)) = self.listener.accept()
            && stream.set_nonblocking(true).is_ok()
        {
            self.visitor = Some(Visitor::new(stream, now));
        }
        let Some(visitor) = &mut self.visitor else { return false };
        let stays = visitor.turn(&mut self.halves, bridge, at, now);
        let restart = !stays && visitor.restart;
        if !stays {
            self.visitor = None;
        }
        restart
    }

    /// Returns the file descriptor to wait for.
    pub(crate) fn fd(&self) -> BorrowedFd<'_> {
        self.visitor.as_ref().map_or(self.listener.as_fd(), |visitor| visitor.stream.as_fd())
    }
}

impl Visitor {
    fn new(stream: TcpStream, now: Instant) -> Self {
        Self {
            stream,
            heard_at: now,
            request: Request::new(),
            updater: None,
            answer: None,
            answered: false,
            restart: false,
        }
    }

    /// Serves the visitor; returns false if the connection can be closed.
    fn turn(
        &mut self,
        halves: &mut Option<Halves>,
        bridge: &mut Bridge,
        at: HostTime,
        now: Instant,
    ) -> bool {
        let mut bytes = [0; 2048];
        loop {
            match self.stream.read(&mut bytes) {
                // The peer has closed its side: the request is complete or broken.
                Ok(0) if self.answered || self.answer.is_none() => return false,
                Ok(0) => break,
                Ok(len) => {
                    self.heard_at = now;
                    if self.answer.is_none() {
                        self.answer = self.take(halves, bridge, at, &bytes[..len]);
                    }
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                Err(_) => return false,
            }
        }
        if let Some(answer) = self.answer.as_mut().filter(|_| !self.answered) {
            while !answer.is_empty() {
                match self.stream.write(answer) {
                    Ok(len @ 1..) => drop(answer.drain(..len)),
                    Err(error) if error.kind() == ErrorKind::Interrupted => {}
                    Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                    _ => return false,
                }
            }
            if answer.is_empty() {
                self.answered = true;
                // The peer may read the reply only after it has sent everything.
                let _ = self.stream.shutdown(std::net::Shutdown::Write);
            }
        }
        now.saturating_duration_since(self.heard_at) < PATIENCE
    }

    /// Adds received bytes; returns the reply once the request is complete.
    fn take(
        &mut self,
        halves: &mut Option<Halves>,
        bridge: &mut Bridge,
        at: HostTime,
        bytes: &[u8],
    ) -> Option<Vec<u8>> {
        let mut bytes = bytes;
        if self.updater.is_none() {
            let from = match self.request.push(bytes) {
                Progress::More => return None,
                Progress::Whole => return Some(answer(bridge, at, &self.request)),
                Progress::Firmware(from) => from,
            };
            let Some(halves) = halves else {
                return Some(refuse(
                    "this bridge accepts no firmware: started without --firmware-key",
                ));
            };
            let wanted = Wanted { target: Target::Host, build: halves.build, key: halves.key };
            self.updater = Some(Updater::new(wanted));
            bytes = &bytes[from..];
        }
        let (Some(halves), Some(updater)) = (halves, &mut self.updater) else { return None };
        if bridge.is_armed() {
            return Some(refuse("the vehicle is armed; land and disarm it first"));
        }
        match updater.feed(halves, bytes) {
            Ok(false) => None,
            Ok(true) => {
                halves.build = updater.build().unwrap_or(halves.build);
                self.restart = true;
                Some(answer_firmware(Ok(())))
            }
            Err(fault) => Some(refuse(Fault::message(fault))),
        }
    }
}

/// Executes a request; returns the reply.
fn answer(bridge: &mut Bridge, at: HostTime, request: &Request) -> Vec<u8> {
    let done = page::act(bridge, at, request);
    let (mut part, mut whole) = (page::Response::new(), Vec::new());
    let mut place = 0;
    while page::respond(bridge, at, request, done, place, &mut part) {
        whole.extend_from_slice(part.as_bytes());
        place += 1;
    }
    whole
}

fn answer_firmware(taken: Result<(), &str>) -> Vec<u8> {
    let mut answer = page::Response::new();
    page::respond_firmware(taken, &mut answer);
    answer.as_bytes().to_vec()
}

fn refuse(why: &str) -> Vec<u8> {
    answer_firmware(Err(why))
}

/// Timeout of a silent browser; it must not block others.
const PATIENCE: Duration = Duration::from_secs(5);
/// Half of the 4 MB flash of an ESP32-C3, without its other partitions. [bytes]
const HALF: usize = 1536 * 1024;
