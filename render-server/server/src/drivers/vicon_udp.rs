//! The socket of the Vicon stream.

use std::collections::VecDeque;
use std::net::{SocketAddr, UdpSocket};
use std::time::Duration;

use anyhow::{Context, Result};
use socket2::{Domain, Protocol, Socket, Type};
use vizflyt_protocol::time::ServerTime;

use super::vicon::ViconStream;
use super::{Measurement, PoseSource, SourceCounters};
use crate::clock;

/// Receives Vicon Tracker's UDP object stream.
#[derive(Debug)]
pub struct ViconUdp {
    socket: UdpSocket,
    address: SocketAddr,
    from: Option<SocketAddr>,
    stream: ViconStream,
    buffer: Box<[u8]>,
    /// When anything last arrived; the start, before anything did.
    heard: ServerTime,
    silence_warned: bool,
    warnings: VecDeque<String>,
}

impl ViconUdp {
    /// Binds `address`; no object is looked for yet.
    pub fn bind(address: SocketAddr) -> Result<Self> {
        let open = || -> std::io::Result<UdpSocket> {
            let kind = Domain::for_address(address);
            let socket = Socket::new(kind, Type::DGRAM, Some(Protocol::UDP))?;
            // A second of Tracker's stream, so that a busy computer loses no frame.
            socket.set_recv_buffer_size(RECEIVE_BUFFER)?;
            socket.bind(&address.into())?;
            Ok(socket.into())
        };
        let socket = open().with_context(|| {
            format!("vicon: cannot listen on {address}; is another server running? try --vicon 127.0.0.1:0")
        })?;
        Ok(Self {
            address: socket.local_addr()?,
            socket,
            from: None,
            stream: ViconStream::new(&[]),
            buffer: vec![0; 65536].into_boxed_slice(),
            heard: clock::now(),
            silence_warned: false,
            warnings: VecDeque::new(),
        })
    }

    /// Yields the poses of the objects named from now on, by their index.
    #[must_use]
    pub fn of(mut self, names: &[&str]) -> Self {
        self.stream = ViconStream::new(names);
        self
    }

    /// Returns where the stream must be sent.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    fn notice_silence(&mut self, now: ServerTime) {
        let silence_s = now.seconds_since(self.heard);
        let allowed_s = if self.from.is_some() { SILENCE_S } else { FIRST_SILENCE_S };
        if self.silence_warned || !(silence_s > allowed_s) {
            return;
        }
        self.silence_warned = true;
        let ms = (silence_s * 1e3).round();
        self.warnings.push_back(match self.from {
            Some(from) => {
                format!("vicon: no sample for {ms} ms from {from}; set Tracker to Live, then retry")
            }
            None => format!(
                "vicon: nothing has come to {} for {ms} ms; in Tracker enable the UDP object \
                 stream to this computer and set it to Live",
                self.address
            ),
        });
    }
}

impl PoseSource for ViconUdp {
    fn receive(&mut self, timeout: Duration) -> &[Measurement] {
        // A zero time-out would mean "for ever" to the socket.
        let timeout = timeout.max(Duration::from_millis(1));
        if self.socket.set_read_timeout(Some(timeout)).is_err() {
            return &[];
        }
        let received = self.socket.recv_from(&mut self.buffer[..]);
        let now = clock::now();
        // Errors are the time-out, or an ICMP complaint about something else: both mean no pose.
        let Ok((length, from)) = received else {
            self.notice_silence(now);
            return &[];
        };
        self.heard = now;
        self.from = Some(from);
        self.silence_warned = false;
        self.stream.handle_packet(now, &self.buffer[..length])
    }

    fn next_warning(&mut self) -> Option<String> {
        self.warnings.pop_front().or_else(|| self.stream.next_warning())
    }

    fn counters(&self, vehicle: usize) -> SourceCounters {
        self.stream.counters(vehicle)
    }
}

/// 1 MiB holds 3 s of 1024-byte packets at 300 Hz.
const RECEIVE_BUFFER: usize = 1 << 20;
/// A hundred frames at 200 Hz. [s]
const SILENCE_S: f64 = 0.5;
/// The simulator, or a person at Tracker, takes a while to start. [s]
const FIRST_SILENCE_S: f64 = 5.0;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_over_a_real_socket_is_read_and_its_end_noticed() {
        let mut source = ViconUdp::bind("127.0.0.1:0".parse().unwrap()).unwrap().of(&["v"]);
        let sender = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut bytes = vec![1, 0, 0, 0, 1, 0, 72, 0];
        bytes.extend_from_slice(b"v");
        bytes.resize(8 + 24, 0);
        for value in [1000.0f64, 0.0, 0.0, 0.0, 0.0, 0.0] {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        sender.send_to(&bytes, source.address()).unwrap();
        let pose = source.receive(Duration::from_secs(30))[0];
        assert_eq!(pose.world_from_body.translation_m.x, 1.0);
        assert_eq!(source.next_warning(), None);
        // As if the last packet had come a second ago.
        source.notice_silence(pose.arrival.plus_seconds(1.0));
        let from = sender.local_addr().unwrap();
        assert_eq!(
            source.next_warning().unwrap(),
            format!("vicon: no sample for 1000 ms from {from}; set Tracker to Live, then retry")
        );
        source.notice_silence(pose.arrival.plus_seconds(2.0));
        assert_eq!(source.next_warning(), None, "said once");
    }
}
