//! Pairing over a connection: transports the messages of [`vizflyt_trust::pairing`].
//!
//! No information about the arena is sent, whether or not the code is right.

use std::time::Duration;

use quinn::{Connection, RecvStream, SendStream};
use serde::de::DeserializeOwned;
use tokio::time::timeout;
use tracing::{info, warn};
use vizflyt_protocol::messages::{PairingReply, PairingRequest, bounded};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{PeerRole, Preamble};
use vizflyt_trust::pairing::{Binding, EXPORTER_LABEL};
use zerocopy::IntoBytes;

use super::control::{Ending, gone};
use super::greeting::{linger, peer};
use super::{END, FOREIGN, REFUSED};
use crate::authorization::Authorizer;

/// Serves one client that requests pairing.
pub(super) async fn run(authorizer: &Authorizer, connection: &Connection) {
    let address = connection.remote_address();
    let ending = timeout(WITHIN, talk(authorizer, connection)).await;
    let (code, reason) =
        ending.unwrap_or_else(|_| (FOREIGN, "pairing did not finish within 10 s".to_owned()));
    if code != END {
        warn!("{address}: not paired: {reason}");
    }
    connection.close(code, reason.as_bytes());
}

async fn talk(authorizer: &Authorizer, connection: &Connection) -> Ending {
    match pair(authorizer, connection).await {
        Ok(name) => {
            info!("{}: '{name}' is paired", connection.remote_address());
            linger(connection, (END, "paired".to_owned())).await
        }
        Err(ending) => ending,
    }
}

/// Returns the client's name when it is paired and has been informed.
async fn pair(authorizer: &Authorizer, connection: &Connection) -> Result<String, Ending> {
    let foreign = |what: &str| (FOREIGN, what.to_owned());
    let mut exporter = [0; 32];
    connection
        .export_keying_material(&mut exporter, EXPORTER_LABEL, &[])
        .map_err(|_| foreign("the connection gives no key material"))?;
    let client = peer(connection).ok_or_else(|| foreign("no certificate was shown"))?;
    let binding = Binding { client, server: authorizer.identity.fingerprint(), exporter };

    let (send, mut recv) = connection.accept_bi().await.map_err(|error| gone(&error))?;
    let mut stream = PairingStream { send, deframer: Box::default() };
    let mut preamble = [0; Preamble::SIZE];
    recv.read_exact(&mut preamble).await.map_err(|error| gone(&error))?;
    let ours = Preamble::of(PeerRole::Server);
    stream.send.write_all(ours.as_bytes()).await.map_err(|error| gone(&error))?;
    if let Err(error) = Preamble::check(&preamble, PeerRole::Server) {
        return Err(linger(connection, (FOREIGN, error.to_string())).await);
    }

    let begin: PairingRequest = stream.read(&mut recv).await?;
    let (attempt, share) = match authorizer.begin_pairing(&begin, &binding) {
        Ok(begun) => begun,
        Err(refusal) => return Err(stream.refuse(connection, &refusal.to_string()).await),
    };
    stream.write(&PairingReply::Share { share }).await?;
    let confirm: PairingRequest = stream.read(&mut recv).await?;
    match authorizer.confirm_pairing(attempt, &confirm, connection.remote_address()) {
        Ok(admitted) => {
            let (proof, grant) = (admitted.proof, admitted.grant);
            stream.write(&PairingReply::Paired { proof, grant }).await?;
            let _ = stream.send.finish();
            Ok(admitted.client.name)
        }
        Err(refusal) => Err(stream.refuse(connection, &refusal).await),
    }
}

struct PairingStream {
    send: SendStream,
    deframer: Box<Deframer>,
}

impl PairingStream {
    async fn write(&mut self, message: &PairingReply) -> Result<(), Ending> {
        let mut buffer = [0; MAX_FRAMED];
        self.send.write_all(encode(message, &mut buffer)).await.map_err(|error| gone(&error))
    }

    async fn refuse(mut self, connection: &Connection, reason: &str) -> Ending {
        if let Err(ending) = self.write(&PairingReply::Refused(bounded(reason))).await {
            return ending;
        }
        let _ = self.send.finish();
        linger(connection, (REFUSED, reason.to_owned())).await
    }

    async fn read<M: DeserializeOwned>(&mut self, recv: &mut RecvStream) -> Result<M, Ending> {
        loop {
            match self.deframer.next() {
                Some(Ok(message)) => return Ok(message),
                Some(Err(error)) => return Err((FOREIGN, error.to_string())),
                None => {}
            }
            let mut bytes = [0; 128];
            let count = recv.read(&mut bytes).await.map_err(|error| gone(&error))?;
            let Some(count) = count else {
                return Err((FOREIGN, "the client left in the middle".to_owned()));
            };
            // After `None` there is room for at least one byte; messages here are far shorter.
            if self.deframer.push(&bytes[..count]) < count {
                return Err((FOREIGN, "more was sent than pairing needs".to_owned()));
            }
        }
    }
}

/// Timeout of a pairing. It is short because the user types the code before the connection is made.
const WITHIN: Duration = Duration::from_secs(10);
