//! Address of the autopilot and transport to it: UDP or TCP in either direction, or a serial line. One thread receives,
//! another sends. Neither blocks for more than 100 ms, except that opening a TCP connection may take 500 ms.

use std::fmt;
use std::io;
use std::net::{SocketAddr, TcpListener, TcpStream, ToSocketAddrs, UdpSocket};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

mod partner;
mod serial;
mod tcp;
mod udp;

use partner::Partner;
pub(crate) use partner::sender_of;
pub use partner::{Intruder, IntruderFault, LinkSigning, Wanted};
use serial::SerialPort;
use tcp::TcpPort;
use udp::UdpPort;

/// Address of the autopilot, as typed after `--mavlink`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MavlinkAddress {
    /// `udpin:ADDR:PORT`: binds, and replies to the wanted autopilot.
    UdpIn(SocketAddr),
    /// `udpout:HOST:PORT`: sends to this address.
    UdpOut(SocketAddr),
    /// `tcpin:ADDR:PORT`: accepts one connection at a time.
    TcpIn(SocketAddr),
    /// `tcpout:HOST:PORT`: connects, and reconnects if the connection breaks.
    TcpOut(SocketAddr),
    /// `serial:PATH:BAUD` or `serial:PATH:BAUD:rtscts`.
    Serial {
        path: PathBuf,
        /// Baud rate. [baud]
        baud: u32,
        /// Whether to use hardware flow control (RTS, CTS).
        flow: bool,
    },
}

/// Parts of an address, before any name lookup.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape<'a> {
    /// Kind and `HOST:PORT`.
    Net(&'a str, &'a str),
    /// Path, baud rate, and whether to use flow control.
    Serial(&'a str, u32, bool),
}

/// Help on the formats of an address.
pub const SHAPES: &str = "write udpin:0.0.0.0:14550, udpout:HOST:PORT, tcpout:HOST:PORT, \
                                 tcpin:ADDR:PORT or serial:/dev/ttyTHS1:921600";
/// Default baud rate, as configured for ArduCopter's telemetry ports and Wi-Fi bridges. [baud]
const USUAL_BAUD: u32 = 921_600;

/// Splits an address into its parts; `None` if it is invalid.
pub fn shape(text: &str) -> Option<Shape<'_>> {
    let (kind, rest) = text.split_once(':')?;
    match kind {
        "udpin" | "udpout" | "tcpin" | "tcpout" => Some(Shape::Net(kind, rest)),
        "serial" => {
            let (rest, flow) =
                rest.strip_suffix(":rtscts").map_or((rest, false), |rest| (rest, true));
            let (path, baud) = match rest.rsplit_once(':') {
                Some((path, baud)) => (path, baud.parse().ok()?),
                None => (rest, USUAL_BAUD),
            };
            let good = path.starts_with('/') && serial::speed(baud).is_some();
            good.then_some(Shape::Serial(path, baud, flow))
        }
        _ => None,
    }
}

/// Default port of ground stations and companion computers.
const USUAL_PORT: u16 = 14550;

impl MavlinkAddress {
    /// Returns the default address.
    pub fn usual() -> Self {
        Self::UdpIn(([0, 0, 0, 0], USUAL_PORT).into())
    }
}

impl FromStr for MavlinkAddress {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let resolve = |address: &str| {
            let mut found =
                address.to_socket_addrs().map_err(|error| format!("{address}: {error}"))?;
            found.next().ok_or_else(|| format!("{address} has no address"))
        };
        match shape(text) {
            Some(Shape::Net("udpin", address)) => Ok(Self::UdpIn(resolve(address)?)),
            Some(Shape::Net("udpout", address)) => Ok(Self::UdpOut(resolve(address)?)),
            Some(Shape::Net("tcpin", address)) => Ok(Self::TcpIn(resolve(address)?)),
            Some(Shape::Net(_, address)) => Ok(Self::TcpOut(resolve(address)?)),
            Some(Shape::Serial(path, baud, flow)) => {
                Ok(Self::Serial { path: Path::new(path).to_owned(), baud, flow })
            }
            None => Err(format!("{text:?} is not a MAVLink address; {SHAPES}")),
        }
    }
}

impl fmt::Display for MavlinkAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpIn(address) => write!(f, "udpin:{address}"),
            Self::UdpOut(address) => write!(f, "udpout:{address}"),
            Self::TcpIn(address) => write!(f, "tcpin:{address}"),
            Self::TcpOut(address) => write!(f, "tcpout:{address}"),
            Self::Serial { path, baud, flow } => {
                write!(f, "serial:{}:{baud}", path.display())?;
                if *flow { f.write_str(":rtscts") } else { Ok(()) }
            }
        }
    }
}

/// Transport to the autopilot, shared by a receiving thread and the control loop.
#[derive(Debug)]
pub struct Port(Transport);

/// Open descriptors of a port, for a second process. Both then share its local address and its connection.
#[derive(Debug)]
pub(crate) struct OpenPort {
    /// UDP: address of the autopilot, if it is known.
    pub(crate) partner: Option<SocketAddr>,
    /// Socket or device; for `tcpin`, the listener and then the connection, if there is one.
    pub(crate) descriptors: Vec<OwnedFd>,
}

#[derive(Debug)]
enum Transport {
    Udp(UdpPort, Box<Mutex<Partner>>),
    Tcp(TcpPort),
    Serial(SerialPort),
}

impl Port {
    /// Opens the transport for the `wanted` autopilot. If a TCP server does not listen yet, the connection is retried.
    ///
    /// # Errors
    /// Returns an error if the socket or device cannot be opened.
    pub fn open(address: &MavlinkAddress, wanted: Wanted) -> io::Result<Self> {
        Ok(Self(match address {
            MavlinkAddress::UdpIn(local) => {
                let partner = Partner::waited_for(wanted, Instant::now());
                Transport::Udp(UdpPort::bind(*local)?, Box::new(Mutex::new(partner)))
            }
            MavlinkAddress::UdpOut(to) => {
                let any = if to.is_ipv4() {
                    SocketAddr::from(([0, 0, 0, 0], 0))
                } else {
                    SocketAddr::from(([0_u16; 8], 0))
                };
                let partner = Partner::fixed(*to, Instant::now());
                Transport::Udp(UdpPort::bind(any)?, Box::new(Mutex::new(partner)))
            }
            MavlinkAddress::TcpIn(local) => Transport::Tcp(TcpPort::listen(*local)?),
            MavlinkAddress::TcpOut(to) => Transport::Tcp(TcpPort::connect(*to)),
            MavlinkAddress::Serial { path, baud, flow } => {
                Transport::Serial(SerialPort::open(path, *baud, *flow)?)
            }
        }))
    }

    /// Returns a port at `address` over the descriptors of another one.
    ///
    /// # Errors
    /// Returns an error if a descriptor is missing or invalid.
    pub(crate) fn adopt(
        address: &MavlinkAddress,
        wanted: Wanted,
        made_at: Instant,
        open: OpenPort,
    ) -> io::Result<Self> {
        let mut descriptors = open.descriptors.into_iter();
        let mut next = || descriptors.next().ok_or(io::ErrorKind::NotConnected);
        Ok(Self(match address {
            MavlinkAddress::UdpIn(_) | MavlinkAddress::UdpOut(_) => {
                let partner = if let MavlinkAddress::UdpOut(to) = address {
                    Partner::fixed(*to, made_at)
                } else {
                    Partner::known(open.partner, wanted, made_at)
                };
                let udp = UdpPort::adopt(UdpSocket::from(next()?));
                Transport::Udp(udp, Box::new(Mutex::new(partner)))
            }
            MavlinkAddress::TcpIn(_) => {
                let listener = TcpListener::from(next()?);
                Transport::Tcp(TcpPort::adopt_listening(listener, next().ok().map(TcpStream::from)))
            }
            MavlinkAddress::TcpOut(to) => {
                Transport::Tcp(TcpPort::adopt(*to, next().ok().map(TcpStream::from)))
            }
            MavlinkAddress::Serial { path, baud, flow } => Transport::Serial(SerialPort::adopt(
                path,
                *baud,
                *flow,
                next().ok().map(std::fs::File::from),
            )?),
        }))
    }

    /// Returns the descriptors of this port.
    ///
    /// # Errors
    /// Returns an error if this process has too many open files.
    pub(crate) fn share(&self) -> io::Result<OpenPort> {
        let (partner, descriptors) = match &self.0 {
            Transport::Udp(udp, partner) => {
                let partner = partner.lock().unwrap_or_else(PoisonError::into_inner).address();
                (partner, vec![udp.share()?])
            }
            Transport::Tcp(tcp) => (None, tcp.share()?),
            Transport::Serial(serial) => (None, serial.share()?),
        };
        Ok(OpenPort { partner, descriptors })
    }

    /// Returns the number of changes of the descriptors or of the partner.
    pub(crate) fn changes(&self) -> u32 {
        match &self.0 {
            Transport::Udp(_, partner) => {
                partner.lock().unwrap_or_else(PoisonError::into_inner).changes()
            }
            Transport::Tcp(tcp) => tcp.changes(),
            Transport::Serial(serial) => serial.changes(),
        }
    }

    /// Returns the local end of the link: the socket's address, or the device.
    ///
    /// # Errors
    /// Returns an error if the socket has no local address.
    pub fn local(&self) -> io::Result<String> {
        match &self.0 {
            Transport::Udp(udp, _) => Ok(udp.local_addr()?.to_string()),
            Transport::Tcp(tcp) => tcp.local(),
            Transport::Serial(serial) => Ok(serial.path().display().to_string()),
        }
    }

    /// Waits at most 100 ms for bytes from the autopilot; `None` if none arrived, or if they came from another sender.
    ///
    /// # Errors
    /// Returns an error if the socket fails for a reason other than a timeout.
    pub fn receive(&self, buffer: &mut [u8]) -> io::Result<Option<usize>> {
        match &self.0 {
            Transport::Udp(udp, partner) => {
                let Some((len, from)) = udp.receive(buffer)? else { return Ok(None) };
                let mut partner = partner.lock().unwrap_or_else(PoisonError::into_inner);
                Ok(partner.accept(from, &buffer[..len], Instant::now()).then_some(len))
            }
            Transport::Tcp(tcp) => Ok(tcp.receive(buffer)),
            Transport::Serial(serial) => Ok(serial.receive(buffer)),
        }
    }

    /// Returns an ignored sender that is due to be reported.
    pub fn poll_intruder(&self) -> Option<Intruder> {
        let Transport::Udp(_, partner) = &self.0 else { return None };
        partner.lock().unwrap_or_else(PoisonError::into_inner).poll_intruder(Instant::now())
    }

    /// Sends whole packets if the peer is known. Errors are ignored: MAVLink tolerates loss.
    pub fn send(&self, bytes: &[u8]) {
        match &self.0 {
            Transport::Udp(udp, partner) => {
                let partner = partner.lock().unwrap_or_else(PoisonError::into_inner).address();
                if let Some(to) = partner {
                    udp.send(bytes, to);
                }
            }
            Transport::Tcp(tcp) => tcp.send(bytes),
            Transport::Serial(serial) => serial.send(bytes),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::partner::tests::heartbeat;
    use super::*;

    #[test]
    fn parses_and_prints_addresses() {
        for text in [
            "udpin:127.0.0.1:14550",
            "udpout:127.0.0.1:14550",
            "tcpin:127.0.0.1:5760",
            "tcpout:[::1]:5760",
            "serial:/dev/ttyTHS1:921600",
            "serial:/dev/ttyUSB0:57600:rtscts",
        ] {
            assert_eq!(text.parse::<MavlinkAddress>().unwrap().to_string(), text);
        }
        let usual: MavlinkAddress = "serial:/dev/ttyACM0".parse().unwrap();
        assert_eq!(usual.to_string(), "serial:/dev/ttyACM0:921600");
        for text in [
            "127.0.0.1:14550",
            "serial:COM3",
            "serial:/dev/ttyS0:12345",
            "udpin:127.0.0.1",
            "tcp:1",
        ] {
            assert!(text.parse::<MavlinkAddress>().is_err(), "{text}");
        }
    }

    fn open(address: &str) -> Port {
        Port::open(&address.parse().unwrap(), Wanted::default()).unwrap()
    }

    /// Checks that packets pass in both directions between two ports.
    fn check(here: &Port, there: &Port) {
        let mut buffer = [0; 64];
        let mut exchange = |from: &Port, to: &Port, text: &[u8]| {
            // The partner may be unknown at first: the other side sends until a packet arrives.
            for _ in 0..100 {
                from.send(text);
                if let Some(len) = to.receive(&mut buffer).unwrap() {
                    assert!(buffer[..len].starts_with(text));
                    return;
                }
                let _ = from.receive(&mut buffer).unwrap();
            }
            panic!("no packet arrived");
        };
        exchange(there, here, &heartbeat(1, None));
        exchange(here, there, b"pong");
    }

    #[test]
    fn udp_sends_in_both_directions() {
        let here = open("udpin:127.0.0.1:0");
        check(&here, &open(&format!("udpout:{}", here.local().unwrap())));
    }

    /// A stranger sends first, and continues to send.
    #[test]
    fn accepts_the_autopilot_after_a_stranger() {
        let here = open("udpin:127.0.0.1:0");
        let to = here.local().unwrap();
        let [stranger, autopilot] =
            [(); 2].map(|()| std::net::UdpSocket::bind("127.0.0.1:0").unwrap());
        let mut buffer = [0; 64];
        let beat = heartbeat(1, None);
        stranger.send_to(b"x", &to).unwrap();
        while here.poll_intruder().is_none() {
            assert_eq!(here.receive(&mut buffer).unwrap(), None);
        }
        stranger.send_to(b"x", &to).unwrap();
        autopilot.send_to(&beat, &to).unwrap();
        let received = std::iter::repeat_with(|| here.receive(&mut buffer).unwrap());
        assert_eq!(received.flatten().next(), Some(beat.len()));
        here.send(b"pong");
        autopilot.set_read_timeout(Some(std::time::Duration::from_mins(1))).unwrap();
        assert_eq!(autopilot.recv(&mut buffer).unwrap(), 4);
    }

    /// A second port over the descriptors of the first continues after the first is gone.
    #[test]
    fn adopted_port_keeps_address_and_partner() {
        let adopt = |first: Port, address: &str| {
            let address = address.parse().unwrap();
            let open = first.share().unwrap();
            drop(first);
            Port::adopt(&address, Wanted::default(), Instant::now(), open).unwrap()
        };
        let mut buffer = [0; 64];
        for kind in ["udp", "tcp"] {
            let address = format!("{kind}in:127.0.0.1:0");
            let here = open(&address);
            let out = format!("{kind}out:{}", here.local().unwrap());
            let there = open(&out);
            check(&here, &there);
            assert_ne!(here.changes(), 0, "the partner, or the connection");
            let (local, there) = (here.local().unwrap(), adopt(there, &out));
            let here = adopt(here, &address);
            assert_eq!(here.local().unwrap(), local);
            // No connection is made and no heartbeat is needed.
            for (from, to) in [(&here, &there), (&there, &here)] {
                from.send(b"pong");
                let received = std::iter::repeat_with(|| to.receive(&mut buffer).unwrap());
                assert_eq!(received.take(100).flatten().next(), Some(4), "{kind}");
            }
        }
        let pty = nix::pty::openpty(None, None).unwrap();
        let address =
            format!("serial:{}:3000000", nix::unistd::ttyname(&pty.slave).unwrap().display());
        let here = adopt(open(&address), &address);
        here.send(b"pong");
        assert_eq!(nix::unistd::read(&pty.master, &mut buffer).unwrap(), 4);
        let second = Port::open(&address.parse().unwrap(), Wanted::default());
        assert_eq!(second.unwrap_err().kind(), io::ErrorKind::AddrInUse, "the device is locked");
    }

    #[test]
    fn tcp_sends_in_both_directions_and_reconnects() {
        let here = open("tcpin:127.0.0.1:0");
        let address = format!("tcpout:{}", here.local().unwrap());
        for _ in 0..2 {
            check(&here, &open(&address));
        }
    }

    #[test]
    fn serial_sends_in_both_directions() {
        use std::io::{Read, Write};
        let pty = nix::pty::openpty(None, None).unwrap();
        let path = nix::unistd::ttyname(&pty.slave).unwrap();
        let address = format!("serial:{}:3000000", path.display());
        let here = open(&address);
        let second = Port::open(&address.parse().unwrap(), Wanted::default());
        assert_eq!(second.unwrap_err().kind(), io::ErrorKind::AddrInUse, "the device is locked");
        let mut far = std::fs::File::from(pty.master);
        // Raw mode: bytes are not changed or echoed.
        let sent: Vec<u8> = (0..=255).collect();
        far.write_all(&sent).unwrap();
        let (mut got, mut buffer) = (Vec::new(), [0; 100]);
        while got.len() < sent.len() {
            let len = here.receive(&mut buffer).unwrap().unwrap();
            got.extend_from_slice(&buffer[..len]);
        }
        assert_eq!(got, sent);
        here.send(&sent);
        let mut got = vec![0; sent.len()];
        far.read_exact(&mut got).unwrap();
        assert_eq!(got, sent);
    }
}
