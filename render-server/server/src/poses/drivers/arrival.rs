//! Arrival time of a datagram by the kernel's stamp (`SO_TIMESTAMPNS`, socket(7)).
//!
//! A process that waits for a processor reads the poses of a tenth of a second at one instant; the kernel has
//! stamped each when it arrived. At 3.6 m/s, an error of 100 ms is an error of 0.36 m.

use std::io::IoSliceMut;
use std::net::{SocketAddr, SocketAddrV4, SocketAddrV6, UdpSocket};
use std::os::fd::AsRawFd;

use nix::cmsg_space;
use nix::sys::socket::{
    ControlMessageOwned, MsgFlags, SockaddrStorage, recvmsg, setsockopt, sockopt,
};
use nix::sys::time::TimeSpec;
use nix::time::{ClockId, clock_gettime};
use vizflyt_protocol::time::ServerTime;

use crate::clock;

/// Receiver of datagrams with their arrival times.
#[derive(Debug)]
pub(super) struct Arrivals {
    /// Buffer for the kernel's stamp.
    control: Vec<u8>,
    /// Arrival time of the last datagram. [server]
    last: ServerTime,
}

/// Length, sender and arrival time of a datagram.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arrival {
    /// Length of the datagram in the buffer.
    pub(super) length: usize,
    pub(super) from: SocketAddr,
    /// Time at which the kernel received it; if the kernel gives no stamp, time at which it was read. [server]
    pub(super) at: ServerTime,
}

impl Arrivals {
    /// Enables kernel stamps for `socket`. If they are unavailable, the time of reading is used.
    pub(super) fn of(socket: &UdpSocket) -> Self {
        let _ = setsockopt(socket, sockopt::ReceiveTimestampns, &true);
        Self { control: cmsg_space!(TimeSpec), last: ServerTime::from_ns(0) }
    }

    /// Waits for the next datagram, at most for the socket's timeout.
    ///
    /// # Errors
    /// Errors of the socket: its timeout, or an ICMP error.
    pub(super) fn receive(
        &mut self,
        socket: &UdpSocket,
        buffer: &mut [u8],
    ) -> nix::Result<Arrival> {
        let mut parts = [IoSliceMut::new(buffer)];
        let message = recvmsg::<SockaddrStorage>(
            socket.as_raw_fd(),
            &mut parts,
            Some(&mut self.control),
            MsgFlags::empty(),
        )?;
        let now = clock::now();
        let stamp = message.cmsgs()?.find_map(|part| match part {
            ControlMessageOwned::ScmTimestampns(stamp) => Some(stamp),
            _ => None,
        });
        self.last = arrival_time(now, stamp.map_or(0.0, waited_s), self.last);
        let from = message.address.as_ref().and_then(address).ok_or(nix::Error::EAFNOSUPPORT)?;
        Ok(Arrival { length: message.bytes, from, at: self.last })
    }
}

/// Returns the arrival time of a datagram that is read at `now` and has waited for `waited_s`. Datagrams arrive in
/// order, so it is not before the arrival of the `last` one, even if the wall clock was set in between.
fn arrival_time(now: ServerTime, waited_s: f64, last: ServerTime) -> ServerTime {
    let at = if waited_s < MAX_WAIT_S { now.plus_seconds(-waited_s) } else { now };
    at.max(last)
}

/// Returns the age of `stamp` on the wall clock, which the kernel uses for stamps. [s]
fn waited_s(stamp: TimeSpec) -> f64 {
    let Ok(wall) = clock_gettime(ClockId::CLOCK_REALTIME) else { return 0.0 };
    let seconds = (wall.tv_sec() - stamp.tv_sec()) as f64;
    (seconds + (wall.tv_nsec() - stamp.tv_nsec()) as f64 * 1e-9).max(0.0)
}

fn address(from: &SockaddrStorage) -> Option<SocketAddr> {
    let v4 = from.as_sockaddr_in().map(|v4| SocketAddr::V4(SocketAddrV4::from(*v4)));
    v4.or_else(|| from.as_sockaddr_in6().map(|v6| SocketAddr::V6(SocketAddrV6::from(*v6))))
}

/// Maximum plausible wait: the buffer holds 3 s of a stream. A longer one means that the wall clock was set.
/// [s]
const MAX_WAIT_S: f64 = 3.0;

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    /// Sends three datagrams, then reads them; returns how far the worst stamp is outside the time of sending.
    /// [s]
    fn worst_s(local: &str) -> f64 {
        let socket = UdpSocket::bind(local).unwrap();
        let mut arrivals = Arrivals::of(&socket);
        let sender = UdpSocket::bind(local).unwrap();
        let mut sent = Vec::new();
        for byte in 0..3u8 {
            let before = clock::now();
            sender.send_to(&[byte; 5], socket.local_addr().unwrap()).unwrap();
            sent.push((before, clock::now()));
            std::thread::sleep(Duration::from_millis(40));
        }
        let (mut buffer, mut worst_s) = ([0; 64], 0.0_f64);
        for (byte, (before, after)) in sent.into_iter().enumerate() {
            let arrival = arrivals.receive(&socket, &mut buffer).unwrap();
            assert_eq!(&buffer[..arrival.length], &[byte as u8; 5]);
            assert_eq!(arrival.from, sender.local_addr().unwrap());
            worst_s =
                worst_s.max(-arrival.at.seconds_since(before)).max(arrival.at.seconds_since(after));
        }
        socket.set_read_timeout(Some(Duration::from_millis(5))).unwrap();
        assert_eq!(arrivals.receive(&socket, &mut buffer).unwrap_err(), nix::Error::EAGAIN);
        worst_s
    }

    #[test]
    fn wall_clock_that_is_set_makes_no_datagram_old() {
        let at = |seconds| ServerTime::from_ns(0).plus_seconds(seconds);
        assert_eq!(arrival_time(at(10.0), 0.2, at(9.0)), at(9.8));
        // The wall clock was set forward by 0.5 s or an hour, or back, between stamp and reading.
        assert_eq!(arrival_time(at(10.01), 0.5, at(10.0)), at(10.0));
        assert_eq!(arrival_time(at(10.01), 3600.0, at(10.0)), at(10.01));
        assert_eq!(arrival_time(at(10.01), 0.0, at(10.0)), at(10.01));
    }

    #[test]
    fn queued_datagrams_have_their_arrival_time() {
        for local in ["127.0.0.1:0", "[::1]:0"] {
            // The two clocks are read one after the other; a preemption between them causes an error, but not
            // every time.
            assert!((0..20).any(|_| worst_s(local) < 5e-3), "{local}");
        }
    }
}
