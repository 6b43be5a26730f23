//! Connection setup, from the first byte to the lease: identity, preambles, `Hello`, and the vehicle, or the
//! reason for a refusal.
//!
//! A client that is not paired receives instructions to pair before any of its bytes is read. A paired client
//! learns only of the vehicles that it may use.

use std::net::IpAddr;
use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, ConnectionError};
use rustls::pki_types::CertificateDer;
use tokio::time::timeout;
use tracing::{info, warn};
use vizflyt_protocol::messages::{Purpose, ToRuntime, ToServer, bounded};
use vizflyt_protocol::packet::{PeerRole, Preamble};
use vizflyt_trust::{Client, Fingerprint};
use zerocopy::IntoBytes;

use super::control::{Ending, Incoming, Outbound, PATIENCE, gone};
use super::session::Session;
use super::{END, FOREIGN, REFUSED, UNPAIRED};
use crate::authorization::Authorizer;
use crate::flights::control_lease::{ControlLease, WatchLease};
use crate::stream::Rooms;

/// Serves one runtime until either side ends the connection.
pub(super) async fn run(
    rooms: Rooms,
    authorizer: Arc<Authorizer>,
    port: u16,
    connection: Connection,
) {
    let address = connection.remote_address();
    let (code, reason) = tokio::select! {
        ending = talk(&rooms, &authorizer, port, &connection) => ending,
        () = rooms.stop.wait() => (END, "the server ends".to_owned()),
    };
    // The close reason of the other side is more informative than the first call that failed here.
    let reason = connection.close_reason().map_or(reason, |error| why(&error));
    info!("{address}: session ends: {reason}");
    // RFC 9000 does not limit the reason's length, but it must fit into a packet.
    let cut: String = reason.chars().take(200).collect();
    connection.close(code, cut.as_bytes());
}

async fn talk(
    rooms: &Rooms,
    authorizer: &Authorizer,
    port: u16,
    connection: &Connection,
) -> Ending {
    let Some(client) = peer(connection).and_then(|fingerprint| authorizer.client(fingerprint))
    else {
        warn!("{}: not paired", connection.remote_address());
        return (UNPAIRED, unpaired(connection, port));
    };
    let opened = timeout(PATIENCE, async {
        let (send, mut recv) = connection.accept_bi().await.map_err(|error| gone(&error))?;
        let mut preamble = [0; Preamble::SIZE];
        recv.read_exact(&mut preamble).await.map_err(|error| gone(&error))?;
        Ok::<_, Ending>((send, recv, preamble))
    });
    let (mut send, recv, preamble) = match opened.await {
        Ok(Ok(opened)) => opened,
        Ok(Err(ending)) => return ending,
        Err(_) => return (FOREIGN, "nothing was received for 5 s".to_owned()),
    };
    // The preamble is sent even to another version: its layout never changes, so that both sides can check it.
    if let Err(error) = send.write_all(Preamble::of(PeerRole::Server).as_bytes()).await {
        return gone(&error);
    }
    if let Err(error) = Preamble::check(&preamble, PeerRole::Server) {
        let reason = error.to_string();
        warn!("{}: {reason}", connection.remote_address());
        let _ = send.finish();
        return linger(connection, (FOREIGN, reason)).await;
    }
    let mut incoming = Incoming::new(recv);
    let hello = match timeout(PATIENCE, incoming.next()).await {
        Ok(Ok(ToServer::Hello(hello))) => hello,
        Ok(Ok(_)) => return (FOREIGN, "the first message was not Hello".to_owned()),
        Ok(Err(ending)) => return ending,
        Err(_) => return (FOREIGN, "no Hello came for 5 s".to_owned()),
    };
    let address = connection.remote_address();
    let granted = permit(&client, &hello.vehicle)
        .and_then(|()| rooms.flights.vehicle(&hello.vehicle))
        .and_then(|vehicle| {
            let lease = match hello.purpose {
                Purpose::Fly => Lease::Fly(Box::new(vehicle.take_control(&hello, address)?)),
                Purpose::Watch => Lease::Watch(vehicle.watch()?),
            };
            Ok((&**vehicle, lease))
        });
    match granted {
        Ok((vehicle, lease)) => {
            let session = Session { rooms, vehicle, connection, hello: &hello };
            let stay = async {
                match &lease {
                    Lease::Fly(lease) => Box::pin(session.fly(lease, send, incoming)).await,
                    Lease::Watch(lease) => Box::pin(session.watch(lease, send, incoming)).await,
                }
            };
            tokio::select! {
                ending = stay => ending,
                () = authorizer.right_ends(client.fingerprint, &hello.vehicle) => {
                    (UNPAIRED, format!("'{}' may no longer use '{}'", client.name, hello.vehicle))
                }
            }
        }
        Err(reason) => {
            warn!("{address}: refused: {reason}");
            let mut out = Outbound::new(send);
            let refusal = ToRuntime::Refused(bounded(&reason));
            if let Err(ending) = out.write(&refusal).await {
                return ending;
            }
            let _ = out.send.finish();
            linger(connection, (REFUSED, reason)).await
        }
    }
}

/// Returns the fingerprint of the other end; TLS has verified that it holds the key.
pub(super) fn peer(connection: &Connection) -> Option<Fingerprint> {
    let chain = connection.peer_identity()?.downcast::<Vec<CertificateDer<'static>>>().ok()?;
    chain.first().map(|certificate| Fingerprint::of(certificate))
}

fn unpaired(connection: &Connection, port: u16) -> String {
    // Address under which the client reached this server, if the system reports it.
    let host = match connection.local_ip().map(|ip| ip.to_canonical()) {
        Some(IpAddr::V6(ip)) => format!("[{ip}]"),
        Some(ip) => ip.to_string(),
        None => "HOST".to_owned(),
    };
    format!(
        "this computer is not paired with the server; run `vizflyt pair {host}:{port}` and type \
         the code from the server's page"
    )
}

fn permit(client: &Client, vehicle: &str) -> Result<(), String> {
    if client.may_use(vehicle) {
        return Ok(());
    }
    let own: Vec<_> = client.vehicles.iter().map(|name| format!("'{name}'")).collect();
    Err(format!("'{}' may use {} here, not '{vehicle}'", client.name, own.join(", ")))
}

/// Rights granted to a session.
enum Lease {
    Fly(Box<ControlLease>),
    Watch(WatchLease),
}

pub(super) fn why(error: &ConnectionError) -> String {
    match error {
        ConnectionError::ApplicationClosed(close) if close.reason.is_empty() => {
            "closed by the runtime".to_owned()
        }
        ConnectionError::ApplicationClosed(close) => {
            format!("closed by the runtime: {}", String::from_utf8_lossy(&close.reason))
        }
        ConnectionError::TimedOut => "nothing came for 5 s".to_owned(),
        other => other.to_string(),
    }
}

/// Waits for the last message to arrive: closing at once would discard it.
pub(super) async fn linger(connection: &Connection, ending: Ending) -> Ending {
    let _ = timeout(Duration::from_secs(2), connection.closed()).await;
    ending
}
