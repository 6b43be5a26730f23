//! A connection from its first byte to its seat: preambles, `Hello`, and which vehicle, or why not.

use std::sync::Arc;
use std::time::Duration;

use quinn::{Connection, ConnectionError};
use tokio::time::timeout;
use tracing::{info, warn};
use vizflyt_protocol::messages::{ToRuntime, ToServer, bounded};
use vizflyt_protocol::packet::{Party, Preamble};
use zerocopy::IntoBytes;

use super::control::{Ending, Incoming, Outbound, PATIENCE, gone};
use super::{END, FOREIGN, REFUSED, session};
use crate::hub::Hub;

/// Speaks with one runtime until either side ends it.
pub(super) async fn run(hub: Arc<Hub>, connection: Connection) {
    let address = connection.remote_address();
    let (code, reason) = tokio::select! {
        ending = talk(&hub, &connection) => ending,
        () = hub.stop.wait() => (END, "the server ends".to_owned()),
    };
    // What the other side said on closing tells more than which of our calls failed first.
    let reason = connection.close_reason().map_or(reason, |error| why(&error));
    info!("{address}: session ends: {reason}");
    // Why: RFC 9000 lets a reason be of any length, but it must fit a packet.
    let cut: String = reason.chars().take(200).collect();
    connection.close(code, cut.as_bytes());
}

async fn talk(hub: &Arc<Hub>, connection: &Connection) -> Ending {
    let opened = timeout(PATIENCE, async {
        let (send, mut recv) = connection.accept_bi().await.map_err(|error| gone(&error))?;
        let mut preamble = [0; Preamble::SIZE];
        recv.read_exact(&mut preamble).await.map_err(|error| gone(&error))?;
        Ok::<_, Ending>((send, recv, preamble))
    });
    let (mut send, recv, preamble) = match opened.await {
        Ok(Ok(opened)) => opened,
        Ok(Err(ending)) => return ending,
        Err(_) => return (FOREIGN, "nothing was said for 5 s".to_owned()),
    };
    // Ours goes out even to another version: its layout never changes, so that both can tell.
    if let Err(error) = send.write_all(Preamble::of(Party::Server).as_bytes()).await {
        return gone(&error);
    }
    if let Err(error) = Preamble::check(&preamble, Party::Server) {
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
    let seat = hub.vehicle(&hello.vehicle).and_then(|vehicle| vehicle.sit(&hello, address));
    match seat {
        Ok(seat) => Box::pin(session::fly(hub, connection, &hello, &seat, send, incoming)).await,
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

/// Gives the last words time to arrive: closing at once would discard them.
async fn linger(connection: &Connection, ending: Ending) -> Ending {
    let _ = timeout(Duration::from_secs(2), connection.closed()).await;
    ending
}
