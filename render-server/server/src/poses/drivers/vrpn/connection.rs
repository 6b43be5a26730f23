//! Connection to a VRPN server: connects, monitors and reconnects. Never waits longer than the given timeout.

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

/// Receiver for the poses of a VRPN server.
#[derive(Debug)]
pub struct VrpnPoses {
    server: SocketAddr,
    stream: VrpnStream,
    link: Link,
    /// Reason of the last failed connection.
    fault: Option<String>,
    /// Time of the last report; initially the start.
    received_at: ServerTime,
    has_received: bool,
    silence_warned: bool,
    /// Time at which a lost connection was last reported.
    lost_at: Option<ServerTime>,
    warnings: VecDeque<String>,
    buffer: Box<[u8]>,
}

/// State of the connection.
#[derive(Debug)]
enum Link {
    /// Not connected; next attempt at `retry_at`.
    Apart {
        retry_at: ServerTime,
    },
    /// Waiting for the server, at most until `until`.
    Connecting {
        socket: Socket,
        until: ServerTime,
    },
    Connected(Socket),
}

impl VrpnPoses {
    /// Creates a source that connects to `server` on the first call of `receive`.
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

    /// Performs the next step of the connection, within `timeout`. Returns whether bytes arrived.
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

    /// Sends the first bytes on a socket that is connected or has failed.
    fn greet(&mut self, mut socket: Socket) {
        let error = socket.take_error().unwrap_or_else(Some);
        // A new socket has room for a few bytes.
        match error.map_or_else(|| socket.write_all(COOKIE), Err) {
            Ok(()) => self.link = Link::Connected(socket),
            Err(error) => self.retry(&error.to_string(), RETRY_S),
        }
    }

    /// Closes the connection, with a warning if it had delivered poses.
    fn lose(&mut self, fault: &str, retry_s: f64) {
        let (now, server) = (clock::now(), self.server);
        // Limits the warnings for a server that connects and disconnects repeatedly.
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

    /// Parses received bytes; returns whether there are poses.
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
                // An immediate retry would fail in the same way.
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
        // Poses that arrived together with the last ones.
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

/// Starts to connect; the socket becomes writable when it is connected.
fn connect(server: SocketAddr) -> std::io::Result<Socket> {
    let socket = Socket::new(Domain::for_address(server), Type::STREAM, Some(Protocol::TCP))?;
    // The client only receives: without keep-alives it would not detect a server that lost its power.
    let alive = TcpKeepalive::new().with_time(ALIVE_EVERY).with_interval(ALIVE_EVERY);
    socket.set_tcp_keepalive(&alive)?;
    // After a regular close by the client, the port of an ended server is held for a minute, and VRPN's own
    // server cannot restart on a held port. A reset frees the port at once; no sent data can be lost by it.
    socket.set_linger(Some(Duration::ZERO))?;
    socket.set_nonblocking(true)?;
    match socket.connect(&server.into()) {
        Err(error) if !is_early(&error) => Err(error),
        _ => Ok(socket),
    }
}

/// Returns whether a socket is not ready yet, instead of broken.
fn is_early(error: &std::io::Error) -> bool {
    const IN_PROGRESS: i32 = nix::errno::Errno::EINPROGRESS as i32;
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted)
        || error.raw_os_error() == Some(IN_PROGRESS)
}

/// Waits until a socket is ready or broken; returns whether it is.
fn wait(socket: &Socket, flags: PollFlags, timeout: Duration) -> bool {
    let ms = timeout.as_micros().div_ceil(1000).min(u128::from(u16::MAX)) as u16;
    let mut sockets = [PollFd::new(socket.as_fd(), flags)];
    poll(&mut sockets, PollTimeout::from(ms)).is_ok_and(|ready| ready > 0)
}

/// Delay before reconnecting to a server that is gone: a user restarts it within seconds. [s]
const RETRY_S: f64 = 0.2;
/// Delay before reconnecting to a server that does not speak VRPN. [s]
const REFUSED_S: f64 = 2.0;
/// Timeout of a connection attempt. [s]
const CONNECT_S: f64 = 2.0;
/// Interval of TCP keep-alives; after nine without a reply the system reports an error.
const ALIVE_EVERY: Duration = Duration::from_secs(1);
/// Silence before a warning: a hundred frames at 200 Hz. [s]
const SILENCE_S: f64 = 0.5;
/// Silence before the first report: the server, or a user at it, needs time to start. [s]
const FIRST_SILENCE_S: f64 = 5.0;
/// Minimum time between warnings of lost connections. [s]
const WARN_EVERY_S: f64 = 5.0;
const AT_FIRST: &str = "is that the address of the motion capture's computer? enable VRPN in its program, and open TCP 3883 in its firewall";
const LATER: &str = "is the motion capture live, and its network there?";

#[cfg(test)]
mod tests;
