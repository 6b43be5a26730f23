//! Rights to connect, over real QUIC to the real binary: a stranger, a team, an instructor.

use std::os::unix::fs::PermissionsExt;

use crate::support::{Client, Emitter, PATIENCE, Server, client, connect_as, write_arena};
use quinn::{ConnectionError, TransportConfig};
use vizflyt_protocol::messages::{Telemetry, ToRuntime, ToServer};
use vizflyt_trust::{Identity, Paired, Role};

fn usual() -> TransportConfig {
    TransportConfig::default()
}

/// Waits until the server closes a connection; returns code and reason.
async fn closed(connection: &quinn::Connection) -> (u64, String) {
    let closing = tokio::time::timeout(PATIENCE, connection.closed()).await;
    match closing.expect("the server closes the connection") {
        ConnectionError::ApplicationClosed(frame) => {
            (frame.error_code.into_inner(), String::from_utf8_lossy(&frame.reason).into_owned())
        }
        other => panic!("{other}"),
    }
}

const UNPAIRED: u64 = vizflyt_protocol::messages::close::UNPAIRED as u64;

#[tokio::test]
async fn a_stranger_receives_only_pairing_instructions() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let stranger = Identity::ephemeral().unwrap();
    let (_endpoint, connection) = connect_as(&server, &stranger, usual()).await.unwrap();
    // The client is silent and does not listen: it is rejected for its identity.
    let (code, reason) = closed(&connection).await;
    assert_eq!(code, UNPAIRED);
    let expected = format!("run `vizflyt pair 127.0.0.1:{}`", server.quic.port());
    assert!(reason.contains(&expected), "{reason}");
    for secret in ["wall", "front", "'vizflyt'"] {
        assert!(!reason.contains(secret), "{reason}");
    }
    let heard = connection.stats();
    assert_eq!((heard.frame_rx.stream, heard.frame_rx.datagram), (0, 0), "no byte was sent");

    // The paired client continues undisturbed.
    let (client, _) = Client::welcomed(&server, usual()).await;
    client.pose().await;
}

#[tokio::test]
async fn a_team_flies_its_own_vehicle_and_no_other() {
    let folder = tempfile::tempdir().unwrap();
    let [own, other] = [(); 2].map(|()| Identity::ephemeral().unwrap());
    let paired = [client(&own, Role::Team, &["vizflyt"]), client(&other, Role::Team, &["wasp"])];
    let server = Server::start_paired(&write_arena(folder.path(), ""), &[], &paired);
    let _emitter = Emitter::start(server.vicon, "vizflyt");
    let mut flying = Client::hello_as(&server, &own, "vizflyt", usual()).await;
    assert!(matches!(flying.next().await, ToRuntime::Welcome(_)));

    for vehicle in ["vizflyt", "bee", ""] {
        let mut thief = Client::hello_as(&server, &other, vehicle, usual()).await;
        let ToRuntime::Refused(text) = thief.next().await else { panic!("let in") };
        assert_eq!(text, format!("'team' may use 'wasp' here, not '{vehicle}'").as_str());
    }
    // The rejected one has not disturbed the flying one.
    flying.send(&ToServer::Telemetry(Telemetry::default())).await;
    flying.pose().await;
}

#[tokio::test]
async fn removing_the_entry_closes_the_connection() {
    let folder = tempfile::tempdir().unwrap();
    let server = Server::start(&write_arena(folder.path(), ""), &[]);
    let (client, _) = Client::welcomed(&server, usual()).await;
    server.keys().write(Paired::FILE, "").unwrap();
    let (code, reason) = closed(&client.connection).await;
    assert_eq!((code, reason.as_str()), (UNPAIRED, "'instructor' may no longer use 'vizflyt'"));
    let (_endpoint, connection) = connect_as(&server, &server.instructor, usual()).await.unwrap();
    assert_eq!(closed(&connection).await.0, UNPAIRED);
}

#[test]
fn the_identity_is_kept_and_never_replaced_silently() {
    let folder = tempfile::tempdir().unwrap();
    let arena = write_arena(folder.path(), "");
    let keys = folder.path().join("keys");
    let option = format!("--keys={}", keys.display());
    let start = || Server::start(&arena, &[&option]);
    let first = start().ready["fingerprint"].clone();
    assert_eq!(start().ready["fingerprint"], first);
    let path = keys.join("server.key");
    let refused = |what: &str| {
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_vizflyt-server"))
            .arg(&arena)
            .arg(&option)
            .output()
            .unwrap();
        let message = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(!output.status.success() && message.contains(what), "{message}");
    };
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o644)).unwrap();
    refused("chmod 600");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).unwrap();
    std::fs::write(&path, "gone").unwrap();
    refused("move it away");
    assert_eq!(std::fs::read_to_string(&path).unwrap(), "gone");
}
