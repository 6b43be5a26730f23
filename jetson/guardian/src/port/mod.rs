//! Where the autopilot is, and the way to it: UDP either way round, TCP either way round, or a serial
//! line. One thread receives, another sends; neither waits longer than a tenth of a second.

use std::fmt;
use std::io;
use std::net::{SocketAddr, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

mod partner;
mod serial;
mod tcp;
mod udp;

use partner::Partner;
pub(crate) use partner::is_flown;
pub use partner::{Intruder, IntruderFault, LinkSigning, Wanted};
use serial::SerialPort;
use tcp::TcpPort;
use udp::UdpPort;

/// Where the autopilot is, as typed after `--mavlink`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MavlinkAddress {
    /// `udpin:ADDR:PORT`: binds, and answers the wanted autopilot.
    UdpIn(SocketAddr),
    /// `udpout:HOST:PORT`: sends there.
    UdpOut(SocketAddr),
    /// `tcpin:ADDR:PORT`: waits for one connection at a time.
    TcpIn(SocketAddr),
    /// `tcpout:HOST:PORT`: connects, and again when the connection breaks.
    TcpOut(SocketAddr),
    /// `serial:PATH:BAUD` or `serial:PATH:BAUD:rtscts`.
    Serial {
        /// The device.
        path: PathBuf,
        /// Its speed. [baud]
        baud: u32,
        /// Whether RTS and CTS are wired.
        flow: bool,
    },
}

/// The parts of an address, nothing looked up yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shape<'a> {
    /// Kind and `HOST:PORT`.
    Net(&'a str, &'a str),
    /// Path, baud and whether with flow control.
    Serial(&'a str, u32, bool),
}

/// What an address may look like.
pub const SHAPES: &str = "write udpin:0.0.0.0:14550, udpout:HOST:PORT, tcpout:HOST:PORT, \
                                 tcpin:ADDR:PORT or serial:/dev/ttyTHS1:921600";
/// What ArduCopter's telemetry ports and Wi-Fi bridges are set to. [baud]
const USUAL_BAUD: u32 = 921_600;

/// Takes an address apart; `None` if it is none.
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

/// Where ground stations and companion computers wait for an autopilot.
const USUAL_PORT: u16 = 14550;

impl MavlinkAddress {
    /// Returns the default.
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
            None => Err(format!("{text:?} is no MAVLink address; {SHAPES}")),
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

/// The transport to the autopilot, shared by a receiving thread and the control loop.
#[derive(Debug)]
pub struct Port(Transport);

#[derive(Debug)]
enum Transport {
    Udp(UdpPort, Box<Mutex<Partner>>),
    Tcp(TcpPort),
    Serial(SerialPort),
}

impl Port {
    /// Opens it, for the `wanted` autopilot. A TCP server that is not there yet is no error: it is tried
    /// again.
    ///
    /// # Errors
    /// The system's refusal of the socket or the device.
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

    /// Returns where others reach us: the socket's address, or the device.
    ///
    /// # Errors
    /// The system's refusal.
    pub fn local(&self) -> io::Result<String> {
        match &self.0 {
            Transport::Udp(udp, _) => Ok(udp.local_addr()?.to_string()),
            Transport::Tcp(tcp) => tcp.local(),
            Transport::Serial(serial) => Ok(serial.path().display().to_string()),
        }
    }

    /// Waits for bytes of the autopilot, 100 ms at most; `None` if none came, or if they are of somebody
    /// else.
    ///
    /// # Errors
    /// An error that waiting longer does not solve.
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

    /// Returns somebody whose datagrams are ignored, and who is to be reported now.
    pub fn poll_intruder(&self) -> Option<Intruder> {
        let Transport::Udp(_, partner) = &self.0 else { return None };
        partner.lock().unwrap_or_else(PoisonError::into_inner).poll_intruder(Instant::now())
    }

    /// Sends whole packets, if anybody is there; loss is the protocol's concern.
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
    fn addresses_are_read_and_printed() {
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

    /// Packets go both ways between two ports.
    fn check(here: &Port, there: &Port) {
        let mut buffer = [0; 64];
        let mut exchange = |from: &Port, to: &Port, text: &[u8]| {
            // The partner may have to be found first: the other side sends until something arrives.
            for _ in 0..100 {
                from.send(text);
                if let Some(len) = to.receive(&mut buffer).unwrap() {
                    assert!(buffer[..len].starts_with(text));
                    return;
                }
                let _ = from.receive(&mut buffer).unwrap();
            }
            panic!("nothing came");
        };
        exchange(there, here, &heartbeat(1, None));
        exchange(here, there, b"pong");
    }

    #[test]
    fn udp_carries_both_ways() {
        let here = open("udpin:127.0.0.1:0");
        check(&here, &open(&format!("udpout:{}", here.local().unwrap())));
    }

    /// Somebody sends first, and goes on.
    #[test]
    fn a_stranger_keeps_no_autopilot_out() {
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

    #[test]
    fn tcp_carries_both_ways_and_reconnects() {
        let here = open("tcpin:127.0.0.1:0");
        let address = format!("tcpout:{}", here.local().unwrap());
        for _ in 0..2 {
            check(&here, &open(&address));
        }
    }

    #[test]
    fn a_serial_line_carries_both_ways() {
        use std::io::{Read, Write};
        let pty = nix::pty::openpty(None, None).unwrap();
        let path = nix::unistd::ttyname(&pty.slave).unwrap();
        let address = format!("serial:{}:3000000", path.display());
        let here = open(&address);
        let second = Port::open(&address.parse().unwrap(), Wanted::default());
        assert_eq!(second.unwrap_err().kind(), io::ErrorKind::AddrInUse, "one program has it");
        let mut far = std::fs::File::from(pty.master);
        // Raw: no byte is changed, none is echoed.
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
