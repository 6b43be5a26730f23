//! The client against a small server of its own, over real QUIC on loopback.

use std::sync::mpsc::{Receiver, channel};

use quinn::{Connection, RecvStream, SendStream, ServerConfig};
use vizflyt_protocol::geometry::{Intrinsics, Pose, Twist, Volume};
use vizflyt_protocol::messages::{ClockReply, EventKind, Limits, Telemetry, ToRuntime, bounded};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{ImageHeader, Party, Preamble};
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::host_now;
use zerocopy::IntoBytes;

use super::*;

/// Far beyond anything a loaded machine needs.
const WAIT: Duration = Duration::from_secs(30);

struct Server {
    endpoint: Endpoint,
    fingerprint: Fingerprint,
}

impl Server {
    fn start() -> Self {
        let identity = Identity::fleeting().unwrap();
        let fingerprint = identity.fingerprint();
        let tls = vizflyt_trust::tls::server_config(&identity, &[ALPN]).unwrap();
        let crypto = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
        let config = ServerConfig::with_crypto(Arc::new(crypto));
        let endpoint = Endpoint::server(config, ([127, 0, 0, 1], 0).into()).unwrap();
        Self { endpoint, fingerprint }
    }

    /// Accepts one runtime up to its Hello.
    async fn accept(&self, preamble: Preamble) -> Peer {
        let connection = self.endpoint.accept().await.unwrap().await.unwrap();
        let (mut send, mut receive) = connection.accept_bi().await.unwrap();
        let mut theirs = [0; Preamble::SIZE];
        receive.read_exact(&mut theirs).await.unwrap();
        assert_eq!(Preamble::check(&theirs, Party::Server), Ok(Party::Runtime));
        send.write_all(preamble.as_bytes()).await.unwrap();
        Peer { connection, send, receive, deframer: Deframer::default() }
    }

    /// Accepts one runtime and welcomes it.
    async fn welcome(&self) -> Peer {
        let mut peer = self.accept(Preamble::of(Party::Server)).await;
        let Some(ToServer::Hello(hello)) = peer.next().await else { panic!("no hello") };
        assert_eq!(hello.vehicle, "vizflyt");
        peer.say(&ToRuntime::Welcome(arena())).await;
        peer
    }
}

struct Peer {
    connection: Connection,
    send: SendStream,
    receive: RecvStream,
    deframer: Deframer,
}

impl Peer {
    async fn say(&mut self, message: &ToRuntime) {
        self.send.write_all(encode(message, &mut [0; MAX_FRAMED])).await.unwrap();
    }

    async fn next(&mut self) -> Option<ToServer> {
        loop {
            if let Some(message) = self.deframer.next() {
                return Some(message.unwrap());
            }
            let mut chunk = [0; 512];
            let len = self.receive.read(&mut chunk).await.ok()??;
            assert_eq!(self.deframer.push(&chunk[..len]), len);
        }
    }

    /// Answers clock requests until something else comes.
    async fn next_but_clock(&mut self) -> Option<ToServer> {
        loop {
            match self.next().await? {
                ToServer::Clock(request) => {
                    // This server's clock is 100 s ahead.
                    let answered = ServerTime::from_ns(host_now().as_ns() + AHEAD_NS);
                    let reply = ClockReply { sent: request.sent, answered };
                    self.say(&ToRuntime::Clock(reply)).await;
                }
                other => return Some(other),
            }
        }
    }
}

const AHEAD_NS: u64 = 100_000_000_000;

fn arena() -> ArenaInfo {
    ArenaInfo {
        name: bounded("test"),
        geofence: Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0)),
        limits: Limits { max_speed_mps: 3.0, max_acceleration_mps2: 4.0 },
        body_radius_m: 0.1,
        takeoff_height_m: 1.0,
        goal_m: None,
        goal_radius_m: 1.0,
        time_limit_s: 0.0,
        cameras: heapless::Vec::new(),
    }
}

struct Client {
    events: Receiver<StreamEvent>,
    outbox: mpsc::Sender<ToServer>,
    shared: Shared,
}

impl Client {
    fn start(server: &Server, fingerprint: Fingerprint) -> Self {
        let (sender, events) = channel();
        let (outbox, outgoing) = mpsc::channel(16);
        let shared = Shared { clock: ServerClock::default(), mailbox: Arc::default() };
        let settings = StreamSettings {
            server: server.endpoint.local_addr().unwrap(),
            fingerprint,
            identity: Identity::fleeting().unwrap(),
            vehicle: bounded("vizflyt"),
        };
        let sender = std::sync::Mutex::new(sender);
        let tell = move |event| {
            let _ = sender.lock().unwrap().send(event);
        };
        tokio::spawn(run(settings, shared.clone(), outgoing, tell));
        Self { events, outbox, shared }
    }

    /// Returns the next event; waits off the async threads.
    fn next(&self) -> StreamEvent {
        tokio::task::block_in_place(|| self.events.recv_timeout(WAIT).unwrap())
    }

    fn refusal(&self) -> String {
        match self.next() {
            StreamEvent::Refused(why) => why,
            other => panic!("{other:?} is no refusal"),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_conversation_and_an_image() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(a) if *a == arena()));

    // The first message that is no clock request; by then the clocks are related.
    client.outbox.send(ToServer::Telemetry(Telemetry::default())).await.unwrap();
    while client.shared.clock.to_host(ServerTime::from_ns(AHEAD_NS)).is_none() {
        let got = tokio::time::timeout(Duration::from_millis(50), peer.next_but_clock()).await;
        assert!(got.is_err() || matches!(got, Ok(Some(ToServer::Telemetry(_)))));
    }
    let stamp = ServerTime::from_ns(host_now().as_ns() + AHEAD_NS);
    let pose =
        PoseSample { stamp, world_from_body: Pose::IDENTITY, twist: Twist::default(), resets: 2 };
    peer.say(&ToRuntime::Pose(pose)).await;
    let StreamEvent::Pose(found, host) = client.next() else { panic!("no pose") };
    assert_eq!(found, pose);
    assert!(host_now().seconds_since(host).abs() < 5.0, "on our clock: {host:?}");
    let event = Event { stamp, kind: EventKind::EmergencyStop, text: bounded("stop") };
    peer.say(&ToRuntime::Event(event.clone())).await;
    assert!(matches!(client.next(), StreamEvent::Event(found) if found == event));

    let k = Intrinsics::from_horizontal_fov(64, 48, 1.5);
    let mut header = ImageHeader::new(9, 0, stamp, &k, &Pose::IDENTITY, &Pose::IDENTITY);
    let payload: Vec<u8> = (0..20_000).map(|n| n as u8).collect();
    header.payload_len = (payload.len() as u32).into();
    for cut in [true, false] {
        let mut stream = peer.connection.open_uni().await.unwrap();
        stream.write_all(header.as_bytes()).await.unwrap();
        let end = if cut { 100 } else { payload.len() };
        stream.write_all(&payload[..end]).await.unwrap();
        stream.finish().unwrap();
    }
    // Nonsense on a stream harms nobody.
    let mut stream = peer.connection.open_uni().await.unwrap();
    stream.write_all(&[7; 500]).await.unwrap();
    stream.finish().unwrap();
    let image = tokio::task::block_in_place(|| client.shared.mailbox.take(WAIT)).unwrap();
    assert_eq!((image.header, image.payload), (header, payload));
    assert!(image.received >= image.pose || host_now().seconds_since(image.pose) < 5.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn another_version_is_refused_by_name() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut bytes = [0; Preamble::SIZE];
    bytes.copy_from_slice(Preamble::of(Party::Server).as_bytes());
    bytes[4] = 99;
    let preamble = zerocopy::FromBytes::read_from_bytes(&bytes).unwrap();
    let _peer = server.accept(preamble).await;
    let why = client.refusal();
    assert!(why.starts_with("server speaks protocol 99, this runtime"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn another_certificate_is_refused_with_its_fingerprint() {
    let server = Server::start();
    let client = Client::start(&server, Fingerprint::of(b"another"));
    let accepting = server.endpoint.clone();
    let _refused = tokio::spawn(async move {
        if let Some(incoming) = accepting.accept().await {
            let _ = incoming.await;
        }
    });
    let why = client.refusal();
    assert!(why.contains(&server.fingerprint.to_string()), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn after_an_outage_or_a_silence_it_connects_anew() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    peer.connection.close(VarInt::from_u32(1), b"restarting");
    assert!(matches!(client.next(), StreamEvent::Down(_)));

    // The second one falls silent: it does not even answer the clock.
    let silent = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    let StreamEvent::Down(why) = client.next() else { panic!("not down") };
    assert!(why.contains("silent"), "{why}");

    let mut third = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    drop(silent);
    client.outbox.send(ToServer::Telemetry(Telemetry::default())).await.unwrap();
    assert!(matches!(third.next_but_clock().await, Some(ToServer::Telemetry(_))));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_refusal_is_tried_again() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut peer = server.accept(Preamble::of(Party::Server)).await;
    peer.say(&ToRuntime::Refused(bounded("another runtime flies vizflyt"))).await;
    let StreamEvent::Down(why) = client.next() else { panic!("not down") };
    assert!(why.contains("another runtime flies"), "{why}");
    let _peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
}
