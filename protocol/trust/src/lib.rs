//! Who may speak with whom. Server and runtime both keep an identity, pin the other's, and pair once
//! by a short code; this is what the two must agree on, and neither may do in its own way.
//!
//! ```text
//! hex          bytes as digits
//! folder       the keys folder: 0700, its files 0600, written whole or not at all
//! identity     an Ed25519 key and its self-signed certificate: server.key, runtime.key
//! fingerprint  SHA-256 of a certificate: who somebody is
//! tls          mutual TLS 1.3 of self-signed certificates; a client pins its server
//! paired       paired.toml on the server: which client may do what
//! servers      servers.toml on a client: which server is which
//! pairing      SPAKE2 over a connection whose ends nobody vouches for yet (sans-IO)
//! ```
//! Nothing here opens a socket or reads a clock. A client is authorised by its fingerprint alone,
//! after TLS has proved that it holds the key.

pub mod fingerprint;
pub mod folder;
mod hex;
pub mod identity;
pub mod paired;
pub mod pairing;
pub mod servers;
pub mod tls;

pub use fingerprint::Fingerprint;
pub use folder::{FileStamp, KeyError, KeysFolder};
pub use hex::{from_hex, hex};
pub use identity::{Identity, Owner, random_instance_id, secret};
pub use paired::{Client, Paired, Role};
pub use servers::{KnownServer, Servers};

/// The protocol's name in the TLS handshake of a runtime.
pub const ALPN: &[u8] = b"vizflyt";
/// The same of a client that pairs.
pub const ALPN_PAIR: &[u8] = b"vizflyt-pair";
