//! Preamble: the first eight bytes that each side sends, with its role and the protocol version.

use zerocopy::byteorder::little_endian::U16;
use zerocopy::{FromBytes, Immutable, IntoBytes, KnownLayout, Unaligned};

use crate::PROTOCOL_VERSION;

/// Role of a peer. Its name appears in error messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PeerRole {
    /// The render server.
    Server,
    /// The runtime on the Jetson.
    Runtime,
    /// A plugin, by way of its SDK.
    Plugin,
}

impl PeerRole {
    fn from_byte(byte: u8) -> Option<Self> {
        match byte {
            1 => Some(Self::Server),
            2 => Some(Self::Runtime),
            3 => Some(Self::Plugin),
            _ => None,
        }
    }

    /// Returns the role's name, for messages.
    pub fn name(self) -> &'static str {
        match self {
            Self::Server => "server",
            Self::Runtime => "runtime",
            Self::Plugin => "plugin",
        }
    }
}

/// Magic bytes, version and role. The layout never changes, so that any two versions can check it.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, FromBytes, IntoBytes, KnownLayout, Immutable, Unaligned,
)]
#[repr(C)]
pub struct Preamble {
    magic: [u8; 4],
    version: U16,
    role: u8,
    reserved: u8,
}

impl Preamble {
    /// Size on the wire. [bytes]
    pub const SIZE: usize = size_of::<Self>();
    const MAGIC: [u8; 4] = *b"VZFL";

    /// Returns the preamble of this build in the role `role`.
    pub fn of(role: PeerRole) -> Self {
        Self {
            magic: Self::MAGIC,
            version: PROTOCOL_VERSION.into(),
            role: role as u8 + 1,
            reserved: 0,
        }
    }

    /// Checks the other side's preamble against this build, whose role is `me`. Returns the peer's role.
    ///
    /// ```
    /// use vizflyt_protocol::packet::{PeerRole, Preamble};
    /// let mut bytes = *zerocopy::IntoBytes::as_bytes(&Preamble::of(PeerRole::Server)).first_chunk::<8>().unwrap();
    /// assert_eq!(Preamble::check(&bytes, PeerRole::Runtime), Ok(PeerRole::Server));
    /// bytes[4] = 99;
    /// let error = Preamble::check(&bytes, PeerRole::Runtime).unwrap_err();
    /// # extern crate std;
    /// # use std::string::ToString;
    /// assert!(error.to_string().starts_with("server speaks protocol 99, this runtime "));
    /// ```
    pub fn check(bytes: &[u8; Self::SIZE], me: PeerRole) -> Result<PeerRole, PreambleError> {
        let Ok(theirs) = Self::read_from_bytes(bytes) else {
            return Err(PreambleError::NotVizflyt);
        };
        let role = PeerRole::from_byte(theirs.role);
        let (Some(them), Self::MAGIC) = (role, theirs.magic) else {
            return Err(PreambleError::NotVizflyt);
        };
        let version = theirs.version.get();
        if version == PROTOCOL_VERSION {
            return Ok(them);
        }
        let older = if version < PROTOCOL_VERSION { them } else { me };
        Err(PreambleError::Version {
            them: them.name(),
            theirs: version,
            me: me.name(),
            ours: PROTOCOL_VERSION,
            older: older.name(),
        })
    }
}

/// Reason for rejecting a peer at its first bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PreambleError {
    /// The bytes are not a preamble.
    #[error("the other side does not speak VizFlyt; check the address and port")]
    NotVizflyt,
    /// The peer has another protocol version.
    #[error("{them} speaks protocol {theirs}, this {me} {ours}: update the {older}")]
    Version {
        /// Role of the peer.
        them: &'static str,
        /// Version of the peer.
        theirs: u16,
        /// Role of this side.
        me: &'static str,
        /// Version of this side.
        ours: u16,
        /// Role of the side that must be updated.
        older: &'static str,
    },
}

#[cfg(test)]
mod tests {
    extern crate std;
    use super::*;
    use std::string::ToString;

    fn check(bytes: [u8; 8], me: PeerRole, expected: Result<PeerRole, &str>) {
        let found = Preamble::check(&bytes, me).map_err(|error| error.to_string());
        assert_eq!(found, expected.map_err(ToString::to_string));
    }

    #[test]
    fn names_the_side_to_update() {
        check(*b"VZFL\x0e\x00\x01\x00", PeerRole::Runtime, Ok(PeerRole::Server));
        check(
            *b"VZFL\x0f\x00\x01\x00",
            PeerRole::Runtime,
            Err("server speaks protocol 15, this runtime 14: update the runtime"),
        );
        check(
            *b"VZFL\x00\x00\x02\x00",
            PeerRole::Server,
            Err("runtime speaks protocol 0, this server 14: update the runtime"),
        );
        let stranger = "the other side does not speak VizFlyt; check the address and port";
        check(*b"HTTP/1.1", PeerRole::Server, Err(stranger));
        check(*b"VZFL\x06\x00\x09\x00", PeerRole::Server, Err(stranger));
    }
}
