//! Pairs this computer with a server: exchanges the messages of [`vizflyt_trust::pairing`], and stores
//! the result.

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use quinn::{ClientConfig, Connection, ConnectionError, RecvStream, SendStream, VarInt};
use tokio::time::timeout;
use vizflyt_protocol::messages::{Grant, PairingReply};
use vizflyt_protocol::packet::framing::{Deframer, MAX_FRAMED, encode};
use vizflyt_protocol::packet::{PeerRole, Preamble};
use vizflyt_trust::pairing::{Binding, Code, EXPORTER_LABEL, PairingClient};
use vizflyt_trust::tls::Pin;
use vizflyt_trust::{ALPN_PAIR, Fingerprint, Identity, KeysFolder, KnownServer, Owner, Servers};
use zerocopy::IntoBytes;

use crate::args::ServerAddress;

/// Result of a pairing.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NowPaired {
    /// Fingerprint of the server, as stored in `servers.toml`.
    pub server: Fingerprint,
    /// Rights of this computer.
    pub grant: Grant,
}

/// Pairs with the server that shows `code`. Later connections need no code.
///
/// # Errors
/// If the server cannot be reached, refuses, or gives a wrong proof of the code, or if keys cannot be
/// read or written.
pub fn pair(
    folder: &KeysFolder,
    server: &ServerAddress,
    code: Code,
    name: &str,
) -> Result<NowPaired> {
    let identity = Identity::load_or_create(folder, Owner::Runtime)?;
    let tokio = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let paired = tokio.block_on(async {
        timeout(WITHIN, connect(&identity, server, code, name))
            .await
            .unwrap_or_else(|_| bail!("server {server}: no answer within 15 s; check the address"))
    })?;
    let address = server.typed.clone();
    Servers::add(folder, KnownServer { address, fingerprint: paired.server })?;
    Ok(paired)
}

async fn connect(
    identity: &Identity,
    server: &ServerAddress,
    code: Code,
    name: &str,
) -> Result<NowPaired> {
    let pin = Pin::none();
    let endpoint = super::endpoint(server.address).context("cannot open a socket")?;
    let tls = pin.client_config(identity, ALPN_PAIR).context("TLS set-up")?;
    let crypto = quinn::crypto::rustls::QuicClientConfig::try_from(tls)
        .context("cannot use TLS for QUIC")?;
    let config = ClientConfig::new(Arc::new(crypto));
    let connection = endpoint
        .connect_with(config, server.address, "vizflyt")
        .with_context(|| format!("server {server}"))?
        .await
        .with_context(|| format!("server {server}: no connection"))?;
    let result = converse(&connection, &pin, identity, code, name).await;
    // The server's close reason is more precise than the error of the first failed call.
    let result = result.map_err(|error| match connection.close_reason() {
        Some(ConnectionError::ApplicationClosed(frame)) if !frame.reason.is_empty() => {
            anyhow::anyhow!("{}", String::from_utf8_lossy(&frame.reason))
        }
        _ => error,
    });
    connection.close(VarInt::from_u32(0), b"bye");
    let _ = timeout(super::RETRY, endpoint.wait_idle()).await;
    result.with_context(|| format!("server {server}"))
}

async fn converse(
    connection: &Connection,
    pin: &Pin,
    identity: &Identity,
    code: Code,
    name: &str,
) -> Result<NowPaired> {
    let server = pin.found().context("the server showed no certificate")?;
    let mut exporter = [0; 32];
    if connection.export_keying_material(&mut exporter, EXPORTER_LABEL, &[]).is_err() {
        bail!("the connection gives no key material");
    }
    let binding = Binding { client: identity.fingerprint(), server, exporter };
    let (mut send, mut recv) = connection.open_bi().await?;
    send.write_all(Preamble::of(PeerRole::Runtime).as_bytes()).await?;
    let mut preamble = [0; Preamble::SIZE];
    let (client, begin) = PairingClient::begin(code, name, binding);
    write(&mut send, &begin).await?;
    recv.read_exact(&mut preamble).await?;
    Preamble::check(&preamble, PeerRole::Runtime)?;

    let mut deframer = Deframer::default();
    let share = match read(&mut recv, &mut deframer).await? {
        PairingReply::Share { share } => share,
        PairingReply::Refused(why) => bail!("{why}"),
        PairingReply::Paired { .. } => bail!(OUT_OF_TURN),
    };
    let Some((confirming, confirm)) = client.confirm(&share) else { bail!(OUT_OF_TURN) };
    write(&mut send, &confirm).await?;
    match read(&mut recv, &mut deframer).await? {
        PairingReply::Paired { proof, grant } if confirming.is_proof(&proof) => {
            Ok(NowPaired { server, grant })
        }
        PairingReply::Paired { .. } => bail!(
            "its proof of the code is wrong: possible man in the middle; do not use this network"
        ),
        PairingReply::Refused(why) => bail!("{why}"),
        PairingReply::Share { .. } => bail!(OUT_OF_TURN),
    }
}

async fn write(send: &mut SendStream, message: &impl serde::Serialize) -> Result<()> {
    let mut buffer = [0; MAX_FRAMED];
    Ok(send.write_all(encode(message, &mut buffer)).await?)
}

async fn read(recv: &mut RecvStream, deframer: &mut Deframer) -> Result<PairingReply> {
    loop {
        if let Some(message) = deframer.next() {
            return Ok(message?);
        }
        let mut bytes = [0; 128];
        let count = recv.read(&mut bytes).await?.context("the server ended the conversation")?;
        if deframer.push(&bytes[..count]) < count {
            bail!(OUT_OF_TURN);
        }
    }
}

/// Timeout of a connection and three messages on a slow network.
const WITHIN: Duration = Duration::from_secs(15);
const OUT_OF_TURN: &str = "it uses another pairing protocol; update the older of the two";
