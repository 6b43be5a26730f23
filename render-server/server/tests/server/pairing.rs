//! Pairing over real QUIC with the real binary: the right code, wrong ones, and a man in the middle.

use std::sync::Arc;

use crate::support::{Client, PATIENCE, Server, connect_as, write_arena};
use quinn::{ClientConfig, Connection, Endpoint, ServerConfig, TransportConfig};
use vizflyt_protocol::messages::{Grant, PairingReply, PairingRequest, ToRuntime};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{PeerRole, Preamble};
use vizflyt_trust::pairing::{Binding, Code, EXPORTER_LABEL, PairingClient};
use vizflyt_trust::tls::{self, Pin};
use vizflyt_trust::{ALPN_PAIR, Fingerprint, Identity, Paired};
use zerocopy::IntoBytes;

/// Starts a server with an open pairing; returns its code.
fn start(folder: &std::path::Path) -> (Server, Code) {
    let server = Server::start(&write_arena(folder, ""), &["--pair", "team:vizflyt"]);
    let code = server.line(|line| line["pairing"]["code"].as_str().map(str::to_owned));
    (server, code.parse().unwrap())
}

/// Connects for pairing to the peer at `address`; also returns its fingerprint.
async fn call(
    address: std::net::SocketAddr,
    identity: &Identity,
) -> (Endpoint, Connection, Fingerprint) {
    let pin = Pin::none();
    let tls = pin.client_config(identity, ALPN_PAIR).unwrap();
    let quic = quinn::crypto::rustls::QuicClientConfig::try_from(tls).unwrap();
    let endpoint = Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap();
    let config = ClientConfig::new(Arc::new(quic));
    let connection = endpoint.connect_with(config, address, "vizflyt").unwrap().await.unwrap();
    (endpoint, connection, pin.found().unwrap())
}

/// Plays the client; returns the server's sentence if it rejects.
async fn pair(
    address: std::net::SocketAddr,
    identity: &Identity,
    code: Code,
) -> Result<Grant, String> {
    let (_endpoint, connection, server) = call(address, identity).await;
    let mut exporter = [0; 32];
    connection.export_keying_material(&mut exporter, EXPORTER_LABEL, &[]).unwrap();
    let binding = Binding { client: identity.fingerprint(), server, exporter };
    let (mut send, mut recv) = connection.open_bi().await.unwrap();
    send.write_all(Preamble::of(PeerRole::Runtime).as_bytes()).await.unwrap();
    let mut theirs = [0; Preamble::SIZE];
    recv.read_exact(&mut theirs).await.unwrap();
    assert_eq!(Preamble::check(&theirs, PeerRole::Runtime), Ok(PeerRole::Server));
    let mut deframer = Deframer::default();
    let mut read = async || {
        loop {
            if let Some(message) = deframer.next::<PairingReply>() {
                return message.unwrap();
            }
            let mut byte = [0; 1];
            recv.read_exact(&mut byte).await.unwrap();
            deframer.push(&byte);
        }
    };
    let (client, begin) = PairingClient::begin(code, "jetson", binding);
    let mut write = async |message: &PairingRequest| {
        send.write_all(encode(message, &mut [0; MAX_FRAMED])).await.unwrap();
    };
    write(&begin).await;
    let share = match read().await {
        PairingReply::Share { share } => share,
        PairingReply::Refused(why) => return Err(why.as_str().to_owned()),
        other @ PairingReply::Paired { .. } => panic!("{other:?}"),
    };
    let (confirming, confirm) = client.confirm(&share).unwrap();
    write(&confirm).await;
    match read().await {
        PairingReply::Paired { proof, grant } => {
            assert!(confirming.is_proof(&proof), "the server knows the code");
            Ok(grant)
        }
        PairingReply::Refused(why) => Err(why.as_str().to_owned()),
        other @ PairingReply::Share { .. } => panic!("{other:?}"),
    }
}

/// Returns a code that is not `code`.
fn other_than(code: Code) -> Code {
    ["111111", "222222"].map(|text| text.parse().unwrap()).into_iter().find(|c| *c != code).unwrap()
}

#[tokio::test]
async fn the_right_code_pairs_once_and_persistently() {
    let folder = tempfile::tempdir().unwrap();
    let (server, code) = start(folder.path());
    let [jetson, late] = [(); 2].map(|()| Identity::ephemeral().unwrap());
    let refused = pair(server.quic, &jetson, other_than(code)).await.unwrap_err();
    assert_eq!(refused, "wrong code, 2 of 3 tries left");
    let Grant::Team { vehicles } = pair(server.quic, &jetson, code).await.unwrap() else {
        panic!()
    };
    assert_eq!(vehicles.iter().map(ToString::to_string).collect::<Vec<_>>(), ["vizflyt"]);
    let mut client =
        Client::hello_as(&server, &jetson, "vizflyt", TransportConfig::default()).await;
    assert!(matches!(client.next().await, ToRuntime::Welcome(_)));
    let kept = Paired::read(&server.keys()).unwrap();
    assert_eq!(kept.client(jetson.fingerprint()).unwrap().name, "jetson");

    let refused = pair(server.quic, &late, code).await.unwrap_err();
    assert!(refused.starts_with("no pairing is open"), "{refused}");
    assert_eq!(Paired::read(&server.keys()).unwrap(), kept);
}

#[tokio::test]
async fn three_wrong_codes_close_the_pairing() {
    let folder = tempfile::tempdir().unwrap();
    let (server, code) = start(folder.path());
    let jetson = Identity::ephemeral().unwrap();
    for expected in ["2 of 3", "1 of 3", "no tries left"] {
        let refused = pair(server.quic, &jetson, other_than(code)).await.unwrap_err();
        assert!(refused.contains(expected), "{refused}");
    }
    let refused = pair(server.quic, &jetson, code).await.unwrap_err();
    assert!(refused.starts_with("no pairing is open"), "{refused}");
    assert_eq!(Paired::read(&server.keys()).unwrap().client(jetson.fingerprint()), None);
}

/// The attacker answers the client as the server, calls the server as the client, and passes every byte on.
#[tokio::test]
async fn a_man_in_the_middle_gains_nothing_from_the_right_code() {
    let folder = tempfile::tempdir().unwrap();
    let (server, code) = start(folder.path());
    let [jetson, middle] = [(); 2].map(|()| Identity::ephemeral().unwrap());
    let tls = tls::server_config(&middle, &[ALPN_PAIR]).unwrap();
    let quic = quinn::crypto::rustls::QuicServerConfig::try_from(tls).unwrap();
    let config = ServerConfig::with_crypto(Arc::new(quic));
    let trap = Endpoint::server(config, "127.0.0.1:0".parse().unwrap()).unwrap();
    let address = trap.local_addr().unwrap();
    let target = server.quic;
    let false_client = middle.clone();
    let relay = tokio::spawn(async move {
        let victim = trap.accept().await.unwrap().await.unwrap();
        let (_endpoint, toward_server, _) = call(target, &false_client).await;
        let (mut to_victim, mut from_victim) = victim.accept_bi().await.unwrap();
        let (mut to_server, mut from_server) = toward_server.open_bi().await.unwrap();
        let up = tokio::io::copy(&mut from_victim, &mut to_server);
        let down = async {
            let copied = tokio::io::copy(&mut from_server, &mut to_victim).await;
            let _ = to_victim.finish();
            copied
        };
        let (_, down) = tokio::join!(up, down);
        victim.closed().await;
        down.unwrap()
    });
    let refused = pair(address, &jetson, code).await.unwrap_err();
    assert_eq!(refused, "wrong code, 2 of 3 tries left");
    let relayed = tokio::time::timeout(PATIENCE, relay).await.unwrap().unwrap();
    assert!(relayed > 40, "the server did answer through him");
    let paired = Paired::read(&server.keys()).unwrap();
    assert!([&jetson, &middle].iter().all(|who| paired.client(who.fingerprint()).is_none()));
}

#[tokio::test]
async fn strangers_run_out_of_attempts() {
    let folder = tempfile::tempdir().unwrap();
    let (server, _) = start(folder.path());
    let stranger = Identity::ephemeral().unwrap();
    let mut refused = None;
    // Far more attempts than one address has, even on a slow machine.
    for _ in 0..500 {
        match connect_as(&server, &stranger, TransportConfig::default()).await {
            Ok((_endpoint, connection)) => drop(connection.closed().await),
            Err(error) => {
                refused = Some(error);
                break;
            }
        }
    }
    assert!(refused.is_some_and(|error| error.contains("refused")));
}
