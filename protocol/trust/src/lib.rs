//! Trust between server and runtime. Each has an identity and pins the other's certificate; they pair once with a short
//! code. This crate contains everything that both sides must implement identically.
//!
//! ```text
//! hex          bytes as hexadecimal digits
//! folder       keys folder: mode 0700, files 0600, written atomically
//! identity     Ed25519 key with self-signed certificate: server.key, runtime.key
//! fingerprint  SHA-256 of a certificate, which identifies a peer
//! tls          mutual TLS 1.3 with self-signed certificates; a client pins its server
//! paired       paired.toml on the server: rights of each client
//! servers      servers.toml on a client: known servers
//! course_secret  secret of the courses of a grade
//! pairing      SPAKE2 over a connection whose peers are not authenticated yet (sans-IO)
//! ```
//! This crate does not open sockets or read clocks. Only the fingerprint authorizes a client, after TLS has proved that
//! the client holds the key.

mod course_secret;
pub mod fingerprint;
pub mod folder;
mod hex;
pub mod identity;
pub mod paired;
pub mod pairing;
pub mod servers;
pub mod tls;

pub use course_secret::{CourseSecret, Purpose};
pub use fingerprint::Fingerprint;
pub use folder::{FileStamp, KeyError, KeysFolder};
pub use hex::{from_hex, hex};
pub use identity::{Identity, Owner, random_instance_id, secret};
pub use paired::{Client, Paired, Role};
pub use servers::{KnownServer, Servers};

/// Name of the runtime's protocol in the TLS handshake.
pub const ALPN: &[u8] = b"vizflyt";
/// Name of the pairing protocol in the TLS handshake.
pub const ALPN_PAIR: &[u8] = b"vizflyt-pair";
