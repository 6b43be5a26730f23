//! Tests of the client with a small server over QUIC on loopback.

use std::sync::mpsc::{Receiver, channel};

use quinn::{Connection, RecvStream, SendStream, ServerConfig};
use vizflyt_protocol::geometry::{Intrinsics, Pose, Volume};
use vizflyt_protocol::messages::{
    ClockReply, Datagram, EventKind, Hello, Limits, Telemetry, ToRuntime, ToServer, Welcome,
    bounded,
};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, encode, encode_body};
use vizflyt_protocol::packet::{ImageHeader, ImageTrailer, PeerRole, Preamble};
use vizflyt_rgbd::{EncodeOptions, Encoder, RgbdView};
use vizflyt_sdk::glam::DVec3;
use vizflyt_sdk::host_now;
use zerocopy::IntoBytes;

use super::*;

/// Timeout of all waits, far above what a loaded machine needs.
const WAIT: Duration = Duration::from_secs(30);

struct Server {
    endpoint: Endpoint,
    fingerprint: Fingerprint,
}

impl Server {
    fn start() -> Self {
        let identity = Identity::ephemeral().unwrap();
        let fingerprint = identity.fingerprint();
        let tls = vizflyt_trust::tls::server_config(&identity, &[ALPN]).unwrap();
        let crypto = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
        let config = ServerConfig::with_crypto(Arc::new(crypto));
        let endpoint = Endpoint::server(config, ([127, 0, 0, 1], 0).into()).unwrap();
        Self { endpoint, fingerprint }
    }

    /// Accepts one runtime, before its Hello.
    async fn accept(&self, preamble: Preamble) -> Peer {
        let connection = self.endpoint.accept().await.unwrap().await.unwrap();
        let (mut send, mut receive) = connection.accept_bi().await.unwrap();
        let mut theirs = [0; Preamble::SIZE];
        receive.read_exact(&mut theirs).await.unwrap();
        assert_eq!(Preamble::check(&theirs, PeerRole::Server), Ok(PeerRole::Runtime));
        send.write_all(preamble.as_bytes()).await.unwrap();
        Peer { connection, send, receive, deframer: Deframer::default() }
    }

    /// Accepts one runtime and welcomes it.
    async fn welcome(&self) -> Peer {
        self.welcome_as(BOOT, |_| 0).await.0
    }

    /// Accepts one runtime and welcomes it as run `boot` of a server that has received the number of
    /// events that `received` returns.
    async fn welcome_as(&self, boot: u64, received: impl Fn(&Hello) -> u64) -> (Peer, Hello) {
        let mut peer = self.accept(Preamble::of(PeerRole::Server)).await;
        let Some(ToServer::Hello(hello)) = peer.next().await else { panic!("no hello") };
        assert_eq!((hello.vehicle.as_str(), hello.purpose), ("vizflyt", Purpose::Fly));
        let received_events = ReceivedEvents { boot: hello.boot, seq: received(&hello) };
        let welcome = Welcome { boot, received_events, arena: arena(), feed_port: 0 };
        peer.send(&ToRuntime::Welcome(welcome)).await;
        (peer, hello)
    }
}

struct Peer {
    connection: Connection,
    send: SendStream,
    receive: RecvStream,
    deframer: Deframer,
}

impl Peer {
    async fn send(&mut self, message: &ToRuntime) {
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

    /// Returns the runtime's next event.
    async fn event(&mut self) -> Option<(u64, Event)> {
        loop {
            if let ToServer::Event { seq, event } = self.next_but_clock().await? {
                return Some((seq, event));
            }
        }
    }

    async fn send_event(&mut self, seq: u64, text: &str) {
        self.send(&ToRuntime::Event { seq, event: note(text) }).await;
    }

    /// Waits until the runtime acknowledges the event `seq`.
    async fn acknowledged(&mut self, seq: u64) {
        while self.next_but_clock().await != Some(ToServer::EventsReceived(seq)) {}
    }

    fn pose(&self, pose: &PoseSample) {
        let mut buffer = [0; MAX_FRAMED];
        let bytes = encode_body(&Datagram::Pose(*pose), &mut buffer).to_vec();
        self.connection.send_datagram(bytes.into()).unwrap();
    }

    /// Answers clock requests until another message arrives, and returns that message.
    async fn next_but_clock(&mut self) -> Option<ToServer> {
        loop {
            match self.next().await? {
                ToServer::Clock(request) => {
                    // This server's clock is 100 s ahead.
                    let answered = ServerTime::from_ns(host_now().as_ns() + AHEAD_NS);
                    let reply = ClockReply { sent: request.sent, answered };
                    let reply = ToRuntime::Clock(reply);
                    // The runtime may have closed the connection after its request, which is the end.
                    self.send.write_all(encode(&reply, &mut [0; MAX_FRAMED])).await.ok()?;
                }
                other => return Some(other),
            }
        }
    }
}

/// `boot` of the server in most tests.
const BOOT: u64 = 77;
const AHEAD_NS: u64 = 100_000_000_000;

fn arena() -> ArenaInfo {
    let hall = Volume::aabb(DVec3::splat(-9.0), DVec3::splat(9.0));
    ArenaInfo::new("test", hall, Limits::new(3.0, 4.0))
}

fn note(text: &str) -> Event {
    Event { stamp: ServerTime::ZERO, kind: EventKind::Note, text: bounded(text) }
}

struct Client {
    events: Receiver<StreamEvent>,
    outbox: Arc<Outbox>,
    shared: Shared,
}

impl Client {
    fn start(server: &Server, fingerprint: Fingerprint) -> Self {
        let (sender, events) = channel();
        let outbox = Arc::new(Outbox::default());
        let shared = Shared {
            clock: ServerClock::default(),
            mailbox: Arc::default(),
            readings: Arc::default(),
        };
        let settings = StreamSettings {
            server: server.endpoint.local_addr().unwrap(),
            fingerprint,
            identity: Identity::ephemeral().unwrap(),
            vehicle: bounded("vizflyt"),
            purpose: Purpose::Fly,
            program: bounded("test"),
        };
        let sender = std::sync::Mutex::new(sender);
        let handle = move |event| sender.lock().unwrap().send(event).is_ok();
        tokio::spawn(run(settings, shared.clone(), Arc::clone(&outbox), handle));
        Self { events, outbox, shared }
    }

    /// Waits for the next event in a blocking section.
    fn next(&self) -> StreamEvent {
        tokio::task::block_in_place(|| self.events.recv_timeout(WAIT).unwrap())
    }

    fn refusal(&self) -> String {
        match self.next() {
            StreamEvent::Refused(why) => why,
            other => panic!("{other:?} is not a refusal"),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn exchanges_messages_and_receives_an_image() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(a) if *a == arena()));

    // Answers clock requests until the client can convert stamps.
    client.outbox.report(Telemetry::default());
    while client.shared.clock.to_host(ServerTime::from_ns(AHEAD_NS)).is_none() {
        let got = tokio::time::timeout(Duration::from_millis(50), peer.next_but_clock()).await;
        assert!(got.is_err() || matches!(got, Ok(Some(ToServer::Telemetry(_)))));
    }
    let stamp = ServerTime::from_ns(host_now().as_ns() + AHEAD_NS);
    let pose = PoseSample { resets: 2, ..PoseSample::still(stamp, Pose::IDENTITY) };
    peer.pose(&pose);
    let StreamEvent::Pose(found, host) = client.next() else { panic!("no pose") };
    assert_eq!(found, pose);
    assert!(host_now().seconds_since(host).abs() < 5.0, "on our clock: {host:?}");
    let event = Event { stamp, kind: EventKind::EmergencyStop, text: bounded("stop") };
    peer.send(&ToRuntime::Event { seq: 1, event: event.clone() }).await;
    assert!(matches!(client.next(), StreamEvent::Event(found) if found == event));

    let k = Intrinsics::from_horizontal_fov(64, 48, 1.5);
    let header = ImageHeader::new(9, 0, stamp, &k, &Pose::IDENTITY, &Pose::IDENTITY);
    let (rgb, depth_mm) = (vec![9; 64 * 48 * 3], vec![1234; 64 * 48]);
    let view = RgbdView { width: 64, height: 48, rgb: &rgb, depth_mm: &depth_mm };
    let mut payload = Vec::new();
    Encoder::new(EncodeOptions::default()).encode(&view, &mut payload).unwrap();
    let trailer = ImageTrailer::new(payload.len() as u32, stamp, stamp);
    for cut in [true, false] {
        let mut stream = peer.connection.open_uni().await.unwrap();
        stream.write_all(header.as_bytes()).await.unwrap();
        let end = if cut { 100 } else { payload.len() };
        stream.write_all(&payload[..end]).await.unwrap();
        if !cut {
            stream.write_all(trailer.as_bytes()).await.unwrap();
        }
        stream.finish().unwrap();
        // One after the other, so that the second does not arrive first.
        let _ = stream.stopped().await;
    }
    // Invalid bytes on a stream have no effect.
    let mut stream = peer.connection.open_uni().await.unwrap();
    stream.write_all(&[7; 500]).await.unwrap();
    stream.finish().unwrap();
    let (mut found, mut whole) = (Vec::new(), None);
    let mut dropped = 0;
    while whole.is_none() {
        let next = || client.shared.mailbox.next(WAIT, |_| true);
        match tokio::task::block_in_place(next).unwrap().1 {
            DecodeStep::Begin(arrival) => {
                assert_eq!(arrival.header, header);
                assert!(arrival.first >= arrival.pose);
                found.clear();
            }
            DecodeStep::Piece(piece) => found.extend_from_slice(&piece),
            DecodeStep::Drop => dropped += 1,
            DecodeStep::End(end) => whole = Some(end),
        }
    }
    assert_eq!((found, whole.unwrap().trailer), (payload, trailer));
    let fates = client.shared.mailbox.fates()[0];
    assert!(dropped <= 1);
    assert_eq!((fates.arrivals.arrived, fates.lost + fates.replaced), (1, 1));
}

#[tokio::test(flavor = "multi_thread")]
async fn drops_a_pose_older_than_the_newest() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    while client.shared.clock.to_host(ServerTime::from_ns(AHEAD_NS)).is_none() {
        let wait = Duration::from_millis(20);
        let _ = tokio::time::timeout(wait, peer.next_but_clock()).await;
    }
    let pose = |ns: u64| PoseSample::still(ServerTime::from_ns(AHEAD_NS + ns), Pose::IDENTITY);
    let mut poison = pose(9);
    poison.twist.linear_mps.x = f64::NAN;
    peer.connection.send_datagram(vec![0xff; 40].into()).unwrap();
    for sample in [poison, pose(5), pose(3), pose(5), pose(8)] {
        peer.pose(&sample);
    }
    let next = || match client.next() {
        StreamEvent::Pose(sample, _) => sample.stamp.as_ns() - AHEAD_NS,
        other => panic!("{other:?} is not a pose"),
    };
    assert_eq!((next(), next()), (5, 8));
}

/// Regression test: events made during an outage were lost, and the server sent all events since the
/// start of the flight again.
#[tokio::test(flavor = "multi_thread")]
async fn delivers_events_once_across_an_outage_in_both_directions() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let (mut peer, hello) = server.welcome_as(BOOT, |_| 0).await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    assert_eq!(hello.received_events, ReceivedEvents::default());
    client.outbox.send_event(note("one"));
    client.outbox.send_event(note("two"));
    assert_eq!(peer.event().await.unwrap(), (1, note("one")));
    assert_eq!(peer.event().await.unwrap(), (2, note("two")));
    // Only the first is acknowledged before the outage, although the second was also received.
    peer.send(&ToRuntime::EventsReceived(1)).await;
    for (seq, text) in [(4, "four"), (9, "nine")] {
        peer.send_event(seq, text).await;
        assert!(matches!(client.next(), StreamEvent::Event(event) if event == note(text)));
    }
    peer.acknowledged(9).await;
    peer.connection.close(VarInt::from_u32(1), b"outage");
    assert!(matches!(client.next(), StreamEvent::Down(_)));
    client.outbox.send_event(note("three"));
    client.outbox.report(Telemetry::default());

    let (mut peer, again) = server.welcome_as(BOOT, |_| 2).await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    assert_eq!(
        (again.boot, again.received_events),
        (hello.boot, ReceivedEvents { boot: BOOT, seq: 9 })
    );
    // An event that the server sends twice is handled once.
    peer.send_event(9, "nine").await;
    peer.send_event(10, "ten").await;
    assert!(matches!(client.next(), StreamEvent::Event(event) if event == note("ten")));
    assert_eq!(peer.event().await.unwrap(), (3, note("three")));
    // The server is restarted: it has received nothing, and numbers its events from 1.
    peer.connection.close(VarInt::from_u32(1), b"restart");
    assert!(matches!(client.next(), StreamEvent::Down(_)));
    let (mut peer, _) = server.welcome_as(BOOT + 1, |_| 0).await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    assert_eq!(peer.event().await.unwrap(), (3, note("three")), "unacknowledged");
    peer.send_event(1, "first").await;
    assert!(matches!(client.next(), StreamEvent::Event(event) if event == note("first")));
    // The client ends when the last event is acknowledged.
    client.outbox.close();
    peer.send(&ToRuntime::EventsReceived(3)).await;
    while peer.next_but_clock().await.is_some() {}
    peer.connection.closed().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn requests_an_event_again_if_it_was_not_accepted() {
    let server = Server::start();
    let (sender, events) = channel();
    let shared =
        Shared { clock: ServerClock::default(), mailbox: Arc::default(), readings: Arc::default() };
    let settings = StreamSettings {
        server: server.endpoint.local_addr().unwrap(),
        fingerprint: server.fingerprint,
        identity: Identity::ephemeral().unwrap(),
        vehicle: bounded("vizflyt"),
        purpose: Purpose::Fly,
        program: bounded("test"),
    };
    let (sender, refused) = (Mutex::new(sender), std::sync::atomic::AtomicBool::new(false));
    // The control loop is stalled when the event arrives for the first time.
    let handle = move |event| {
        let is_event = matches!(event, StreamEvent::Event(_));
        let stalled = is_event && !refused.swap(true, std::sync::atomic::Ordering::Relaxed);
        !stalled && sender.lock().unwrap().send(event).is_ok()
    };
    tokio::spawn(run(settings, shared, Arc::default(), handle));
    let mut peer = server.welcome().await;
    peer.send_event(1, "stop").await;
    let (mut again, hello) = server.welcome_as(BOOT, |_| 0).await;
    assert_eq!(hello.received_events.of(BOOT), 0);
    again.send_event(1, "stop").await;
    let wait = || events.recv_timeout(WAIT).unwrap();
    while !matches!(tokio::task::block_in_place(wait), StreamEvent::Event(e) if e == note("stop")) {
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn rejects_another_protocol_version_by_name() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut bytes = [0; Preamble::SIZE];
    bytes.copy_from_slice(Preamble::of(PeerRole::Server).as_bytes());
    bytes[4] = 99;
    let preamble = zerocopy::FromBytes::read_from_bytes(&bytes).unwrap();
    let _peer = server.accept(preamble).await;
    let why = client.refusal();
    assert!(why.starts_with("server speaks protocol 99, this runtime"), "{why}");
}

#[tokio::test(flavor = "multi_thread")]
async fn rejects_another_certificate_and_reports_its_fingerprint() {
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
async fn reconnects_after_an_outage_or_a_silence() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    peer.connection.close(VarInt::from_u32(1), b"restarting");
    assert!(matches!(client.next(), StreamEvent::Down(_)));

    // The second server is silent, also to clock requests.
    let silent = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    let StreamEvent::Down(why) = client.next() else { panic!("not down") };
    assert!(why.contains("silent"), "{why}");

    let mut third = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
    drop(silent);
    client.outbox.report(Telemetry::default());
    while !matches!(third.next_but_clock().await, Some(ToServer::Telemetry(_))) {}
}

#[tokio::test(flavor = "multi_thread")]
async fn retries_after_a_refusal() {
    let server = Server::start();
    let client = Client::start(&server, server.fingerprint);
    let mut peer = server.accept(Preamble::of(PeerRole::Server)).await;
    peer.send(&ToRuntime::Refused(bounded("another runtime flies vizflyt"))).await;
    let StreamEvent::Down(why) = client.next() else { panic!("not down") };
    assert!(why.contains("another runtime flies"), "{why}");
    let _peer = server.welcome().await;
    assert!(matches!(client.next(), StreamEvent::Welcome(_)));
}
