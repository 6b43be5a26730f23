//! Client of a bridge on the network: requests and replies in MAVLink's TUNNEL message
//! (`vizflyt_bridge::access`).

use std::net::{SocketAddr, ToSocketAddrs, UdpSocket};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use vizflyt_bridge::access::{BODY, HEAD, Op, Status, TUNNEL_TYPE, proof};
use vizflyt_bridge::bridge::COMPONENT_ID;
use vizflyt_bridge::mavlink_writer::write_packet;
use vizflyt_bridge::packet::{CutStats, each_in_datagram};
use vizflyt_bridge::settings::Key;
use vizflyt_protocol::mavlink::MAX_PACKET;

/// Message id of TUNNEL.
const TUNNEL: u32 = 385;
/// System and component id of this client: MAV_COMP_ID_ONBOARD_COMPUTER4 of a ground station.
const SOURCE: (u8, u8) = (255, 194);
/// Timeout for a reply; then the request is repeated.
const PATIENCE: Duration = Duration::from_millis(400);
/// Maximum number of attempts.
const ATTEMPTS: u8 = 6;

/// A bridge on the network.
pub(crate) struct BridgeClient {
    socket: UdpSocket,
    address: SocketAddr,
    sequence: u8,
    random: [u8; 16],
    counter: u32,
    /// Whether the bridge has a key.
    pub(crate) claimed: bool,
    /// Whether the bridge passes bytes unparsed.
    pub(crate) transparent: bool,
    /// Firmware version.
    pub(crate) version: String,
}

impl BridgeClient {
    /// Queries the bridge at `address`.
    pub(crate) fn open(address: &str) -> Result<Self> {
        let with_port =
            if address.contains(':') { address.to_owned() } else { format!("{address}:14550") };
        let resolved = with_port
            .to_socket_addrs()
            .with_context(|| {
                format!("bridge: {address} has no address; give its IPv4 address, or NAME.local")
            })?
            .find(SocketAddr::is_ipv4)
            .with_context(|| {
                format!("bridge: {address} has no IPv4 address; give its IPv4 address")
            })?;
        let socket = UdpSocket::bind("0.0.0.0:0").context("bridge: cannot open a socket")?;
        socket.set_read_timeout(Some(Duration::from_millis(50)))?;
        let mut client = Self {
            socket,
            address: resolved,
            sequence: 0,
            random: [0; 16],
            counter: 0,
            claimed: false,
            transparent: false,
            version: String::new(),
        };
        let (_, hello) = client.ask(Op::Hello, b"", None)?;
        let (Some(random), Some(counter), Some(&flags)) = (
            hello.first_chunk(),
            hello.get(16..20).and_then(|bytes| bytes.try_into().ok()),
            hello.get(20),
        ) else {
            bail!(
                "bridge: {address} replied, but not with the bridge protocol; check the address, and update the older \
                 of firmware and program"
            );
        };
        client.random = *random;
        client.counter = u32::from_le_bytes(counter);
        client.claimed = flags & 1 != 0;
        client.transparent = flags & 4 != 0;
        client.version = String::from_utf8_lossy(&hello[21..]).into_owned();
        Ok(client)
    }

    /// Sends a request and returns status and body of the reply. Changes need `key`.
    pub(crate) fn ask(
        &mut self,
        op: Op,
        body: &[u8],
        key: Option<&Key>,
    ) -> Result<(Status, Vec<u8>)> {
        let proof_len = if key.is_some() { vizflyt_bridge::access::PROOF } else { 0 };
        if HEAD + body.len() + proof_len > BODY {
            bail!("bridge: a request of {} bytes is too long", body.len());
        }
        for _ in 0..ATTEMPTS {
            // Each repetition has its own counter: possibly the reply was lost, not the request.
            self.counter += 1;
            let mut request = vec![op as u8];
            request.extend_from_slice(&self.counter.to_le_bytes());
            request.extend_from_slice(body);
            if let Some(key) = key {
                let proof = proof(key, &self.random, &request);
                request.extend_from_slice(&proof);
            }
            self.send(&request)?;
            let until = Instant::now() + PATIENCE;
            while Instant::now() < until {
                if let Some(answer) = self.receive(op) {
                    return Ok(answer);
                }
            }
        }
        bail!(
            "bridge: {} does not reply; check that it is on, and that this computer is in its network",
            self.address
        )
    }

    fn send(&mut self, request: &[u8]) -> Result<()> {
        let [low, high] = TUNNEL_TYPE.to_le_bytes();
        // The vehicle's system id may be unknown: zero addresses any.
        let mut payload = vec![low, high, 0, COMPONENT_ID, request.len() as u8];
        payload.extend_from_slice(request);
        let mut packet = [0; MAX_PACKET];
        let len = write_packet(&mut packet, SOURCE, self.sequence, TUNNEL, &payload);
        self.sequence = self.sequence.wrapping_add(1);
        self.socket
            .send_to(&packet[..len], self.address)
            .with_context(|| format!("bridge: cannot send to {}", self.address))?;
        Ok(())
    }

    /// Waits up to the socket's timeout for the reply, and ignores telemetry.
    fn receive(&self, op: Op) -> Option<(Status, Vec<u8>)> {
        let mut bytes = [0; 2048];
        // Timeout or refused: the caller repeats the request.
        let (len, from) = self.socket.recv_from(&mut bytes).ok()?;
        if from != self.address {
            return None;
        }
        let mut answer = None;
        each_in_datagram(&bytes[..len], &mut CutStats::default(), |packet| {
            if packet.id() != TUNNEL || packet.source().1 != COMPONENT_ID {
                return;
            }
            let mut payload = packet.payload().to_vec();
            payload.resize(5 + BODY, 0);
            let len = usize::from(payload[4]).min(BODY);
            let body = &payload[5..5 + len];
            if payload[..2] == TUNNEL_TYPE.to_le_bytes()
                && let [number, status, rest @ ..] = body
                && *number == op as u8 | 0x80
                && let Some(status) = Status::from_number(*status)
            {
                answer = Some((status, rest.to_vec()));
            }
        });
        answer
    }
}
