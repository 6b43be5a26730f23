//! The emulated bridge's page, which takes settings and firmware too: one browser after another, as on a
//! chip, without ever waiting for it.

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

/// The page.
pub(crate) struct Page {
    listener: TcpListener,
    visitor: Option<Visitor>,
    halves: Option<Halves>,
}

/// A browser, or somebody who brings a firmware.
struct Visitor {
    stream: TcpStream,
    heard_at: Instant,
    request: Request,
    updater: Option<Updater>,
    answer: Option<Vec<u8>>,
    /// The answer is out; what still comes is read, so that it is not lost to a reset.
    answered: bool,
    restart: bool,
}

/// The spare half of a flash, and which firmware it takes. What is taken is verified as on a chip; this
/// computer cannot run it, so only its number counts from then on.
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
    /// Listens at `address`; takes firmware if there is the public half of the key that signs it.
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

    /// Serves whoever is there; returns true if the bridge shall restart, with a new firmware.
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

    /// Returns what to wait for.
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

    /// Returns false once it is done with.
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
                // Nothing more comes: whole or not, that was it.
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
                // Whoever still sends reads the answer only after that.
                let _ = self.stream.shutdown(std::net::Shutdown::Write);
            }
        }
        now.saturating_duration_since(self.heard_at) < PATIENCE
    }

    /// Takes bytes; returns the answer once there is one.
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
                return Some(refuse("this bridge takes no firmware: no --firmware-key was given"));
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

/// Does what a request asks for; returns the answer.
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

/// A browser that is silent for so long must not keep others out.
const PATIENCE: Duration = Duration::from_secs(5);
/// Half of an ESP32-C3's flash of 4 MB, less what else is in it. [bytes]
const HALF: usize = 1536 * 1024;
