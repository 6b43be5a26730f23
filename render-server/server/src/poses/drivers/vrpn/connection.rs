//! The connection to a VRPN server: made, watched and made again. Never waits longer than it is asked to.

use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::SocketAddr;
use std::os::fd::AsFd;
use std::time::Duration;

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use socket2::{Domain, Protocol, Socket, TcpKeepalive, Type};
use vizflyt_protocol::time::ServerTime;

use super::{COOKIE, VrpnStream};
use crate::clock;
use crate::poses::drivers::source::{Measurement, PoseSource, SourceCounters};

/// Receives the poses of a VRPN server.
#[derive(Debug)]
pub struct VrpnPoses {
    server: SocketAddr,
    stream: VrpnStream,
    link: Link,
    /// Why there was no connection, the last time.
    fault: Option<String>,
    /// When the last report came; the start, before any did.
    received_at: ServerTime,
    has_received: bool,
    silence_warned: bool,
    /// When the loss of a connection was last reported.
    lost_at: Option<ServerTime>,
    warnings: VecDeque<String>,
    buffer: Box<[u8]>,
}

/// How far the connection is.
#[derive(Debug)]
enum Link {
    /// There is none; the next attempt is then.
    Apart { retry_at: ServerTime },
    /// The server has not answered yet; it is given up then.
    Connecting { socket: Socket, until: ServerTime },
    /// It stands.
    Connected(Socket),
}

impl VrpnPoses {
    /// Makes a source that connects to `server` when it is first asked.
    pub fn new(server: SocketAddr, stream: VrpnStream) -> Self {
        let now = clock::now();
        Self {
            server,
            stream,
            link: Link::Apart { retry_at: now },
            fault: None,
            received_at: now,
            has_received: false,
            silence_warned: false,
            lost_at: None,
            warnings: VecDeque::new(),
            buffer: vec![0; 1 << 16].into_boxed_slice(),
        }
    }

    /// Does what the connection's state asks for, within `timeout`; returns whether bytes came.
    fn advance(&mut self, now: ServerTime, timeout: Duration) -> bool {
        match std::mem::replace(&mut self.link, Link::Apart { retry_at: now }) {
            Link::Apart { retry_at } if retry_at > now => {
                let left = Duration::from_secs_f64(retry_at.seconds_since(now));
                self.link = Link::Apart { retry_at };
                std::thread::sleep(timeout.min(left));
            }
            Link::Apart { .. } => match connect(self.server) {
                Ok(socket) => {
                    let until = now.plus_seconds(CONNECT_S);
                    self.link = Link::Connecting { socket, until };
                }
                Err(error) => self.retry(&error.to_string(), RETRY_S),
            },
            Link::Connecting { socket, until } => {
                if wait(&socket, PollFlags::POLLOUT, timeout) {
                    self.greet(socket);
                } else if now >= until {
                    self.retry("it does not answer", RETRY_S);
                } else {
                    self.link = Link::Connecting { socket, until };
                }
            }
            Link::Connected(socket) => {
                if !wait(&socket, PollFlags::POLLIN, timeout) {
                    self.link = Link::Connected(socket);
                    return false;
                }
                let read = (&socket).read(&mut self.buffer);
                self.link = Link::Connected(socket);
                match read {
                    Ok(0) => self.lose("it has closed the connection", RETRY_S),
                    Ok(length) => {
                        self.stream.handle_bytes(clock::now(), &self.buffer[..length]);
                        return true;
                    }
                    Err(error) if is_early(&error) => {}
                    Err(error) => self.lose(&error.to_string(), RETRY_S),
                }
            }
        }
        false
    }

    /// Begins the conversation on a socket that is connected, or could not be.
    fn greet(&mut self, mut socket: Socket) {
        let error = socket.take_error().unwrap_or_else(Some);
        // A socket that was just made has room for a few bytes.
        match error.map_or_else(|| socket.write_all(COOKIE), Err) {
            Ok(()) => self.link = Link::Connected(socket),
            Err(error) => self.retry(&error.to_string(), RETRY_S),
        }
    }

    /// Gives up the connection. Says so if it had brought poses.
    fn lose(&mut self, fault: &str, retry_s: f64) {
        let (now, server) = (clock::now(), self.server);
        // A server that comes and goes is not reported at every turn.
        let is_news = self.lost_at.is_none_or(|at| now.seconds_since(at) > WARN_EVERY_S);
        if is_news && self.stream.newest_at().is_some() {
            (self.lost_at, self.silence_warned) = (Some(now), true);
            self.warnings
                .push_back(format!("vrpn: the connection to {server} was lost: {fault}; {LATER}"));
        }
        self.stream.begin_connection();
        self.retry(fault, retry_s);
    }

    fn retry(&mut self, fault: &str, retry_s: f64) {
        self.link = Link::Apart { retry_at: clock::now().plus_seconds(retry_s) };
        self.fault = Some(fault.to_owned());
    }

    /// Reads on in what has come; returns whether there are poses.
    fn read(&mut self) -> bool {
        match self.stream.read() {
            Ok(has_poses) => {
                if let Some(at) = self.stream.newest_at() {
                    self.silence_warned &= at == self.received_at;
                    (self.received_at, self.has_received) = (at, true);
                }
                has_poses
            }
            Err(error) => {
                self.stream.refuse(error);
                // It would say the same again at once.
                self.lose(&error.to_string(), REFUSED_S);
                false
            }
        }
    }

    fn is_connected(&self) -> bool {
        matches!(self.link, Link::Connected(_))
    }

    fn notice_silence(&mut self, now: ServerTime) {
        let silence_s = now.seconds_since(self.received_at);
        let allowed_s = if self.has_received { SILENCE_S } else { FIRST_SILENCE_S };
        if self.silence_warned || !(silence_s > allowed_s) {
            return;
        }
        self.silence_warned = true;
        let (server, ms) = (self.server, (silence_s * 1e3).round());
        let described = self.stream.described().filter(|_| self.is_connected());
        self.warnings.push_back(match (described, &self.fault) {
            (Some(_), _) if self.has_received => {
                format!("vrpn: no sample for {ms} ms from {server}; {LATER}")
            }
            (Some(has), _) => format!(
                "vrpn: {server} has sent no pose for {ms} ms; it has {has}; is one of them a tracker, and \
                 is it seen?"
            ),
            (None, Some(fault)) if !self.is_connected() => {
                format!("vrpn: cannot connect to {server} for {ms} ms: {fault}; {AT_FIRST}")
            }
            (None, _) => {
                format!("vrpn: {server} has not answered for {ms} ms; {AT_FIRST}")
            }
        });
    }
}

impl PoseSource for VrpnPoses {
    fn receive(&mut self, timeout: Duration) -> &[Measurement] {
        // What came together with the last poses.
        let mut has_poses = self.read();
        if !has_poses {
            let came = self.advance(clock::now(), timeout.max(Duration::from_millis(1)));
            has_poses = came && self.read();
            self.notice_silence(clock::now());
        }
        if has_poses { self.stream.measured() } else { &[] }
    }

    fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front().or_else(|| self.stream.next_warning())
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.stream.counters(vehicle)
    }
}

/// Begins to connect; the socket can be written to once it has.
fn connect(server: SocketAddr) -> std::io::Result<Socket> {
    let socket = Socket::new(Domain::for_address(server), Type::STREAM, Some(Protocol::TCP))?;
    // We only listen: without a question now and then a server that lost its power would be silent for ever.
    let alive = TcpKeepalive::new().with_time(ALIVE_EVERY).with_interval(ALIVE_EVERY);
    socket.set_tcp_keepalive(&alive)?;
    // Once a server has ended, its port is held for a minute where the other end says a proper goodbye, and VRPN's own server
    // cannot be started again on a port that is held. A reset frees it at once; nothing that we send can be lost by it.
    socket.set_linger(Some(Duration::ZERO))?;
    socket.set_nonblocking(true)?;
    match socket.connect(&server.into()) {
        Err(error) if !is_early(&error) => Err(error),
        _ => Ok(socket),
    }
}

/// Whether a socket is not ready, rather than broken.
fn is_early(error: &std::io::Error) -> bool {
    const IN_PROGRESS: i32 = nix::errno::Errno::EINPROGRESS as i32;
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted)
        || error.raw_os_error() == Some(IN_PROGRESS)
}

/// Waits until a socket is ready, or broken; returns whether it is.
fn wait(socket: &Socket, flags: PollFlags, timeout: Duration) -> bool {
    let ms = timeout.as_micros().div_ceil(1000).min(u128::from(u16::MAX)) as u16;
    let mut sockets = [PollFd::new(socket.as_fd(), flags)];
    poll(&mut sockets, PollTimeout::from(ms)).is_ok_and(|ready| ready > 0)
}

/// How soon a server that is gone is looked for again: a person restarts it in seconds. [s]
const RETRY_S: f64 = 0.2;
/// How soon what is no VRPN server is tried again. [s]
const REFUSED_S: f64 = 2.0;
/// How long a server may take to answer. [s]
const CONNECT_S: f64 = 2.0;
/// How often the system asks a silent server whether it is there; of nine unanswered ones it makes an error.
const ALIVE_EVERY: Duration = Duration::from_secs(1);
/// A hundred frames at 200 Hz. [s]
const SILENCE_S: f64 = 0.5;
/// The server, or a person at it, takes a while to start. [s]
const FIRST_SILENCE_S: f64 = 5.0;
/// How often the loss of a connection is reported. [s]
const WARN_EVERY_S: f64 = 5.0;
const AT_FIRST: &str = "is that the address of the motion capture's computer? enable VRPN in its program, and open TCP 3883 in its firewall";
const LATER: &str = "is the motion capture live, and its network there?";

#[cfg(test)]
mod tests;
