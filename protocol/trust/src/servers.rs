//! `servers.toml`: servers known to the computer of a runtime.

use serde::{Deserialize, Serialize};

use crate::Fingerprint;
use crate::folder::{KeyError, KeysFolder};

/// Server with which this computer is paired.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownServer {
    /// `HOST:PORT`, as typed by the user.
    pub address: String,
    /// Fingerprint of its certificate.
    pub fingerprint: Fingerprint,
}

/// All servers with which this computer is paired.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Servers {
    /// Servers in the order of the file.
    #[serde(default, rename = "server")]
    pub servers: Vec<KnownServer>,
}

impl Servers {
    /// Name of the file in the keys folder.
    pub const FILE: &str = "servers.toml";

    /// Parses and checks the text of the file.
    ///
    /// # Errors
    /// Returns a sentence with the position and the error.
    pub fn parse(text: &str) -> Result<Self, String> {
        let servers: Self = toml::from_str(text).map_err(|error| error.to_string())?;
        for (index, server) in servers.servers.iter().enumerate() {
            let address = &server.address;
            if servers.servers[..index].iter().any(|other| other.address == *address) {
                return Err(format!("'{address}' occurs twice; keep one of the two entries"));
            }
        }
        Ok(servers)
    }

    /// Reads the file of a keys folder. Without a file, the list is empty.
    pub fn read(folder: &KeysFolder) -> Result<Self, KeyError> {
        let text = folder.read(Self::FILE)?.unwrap_or_default();
        Self::parse(&text).map_err(|what| KeyError::Damaged { path: folder.file(Self::FILE), what })
    }

    /// Adds a server, and replaces an entry with the same address.
    pub fn add(folder: &KeysFolder, server: KnownServer) -> Result<(), KeyError> {
        let mut known = Self::read(folder)?;
        known.servers.retain(|other| other.address != server.address);
        known.servers.push(server);
        let text = toml::to_string(&known).map_err(|error| KeyError::Damaged {
            path: folder.file(Self::FILE),
            what: error.to_string(),
        })?;
        folder.write(Self::FILE, &(HEAD.to_owned() + &text))
    }

    /// Returns the fingerprint of the first of `addresses` that is known: the address as typed by the user, then the
    /// resolved one.
    pub fn fingerprint(&self, addresses: &[&str]) -> Option<Fingerprint> {
        let at = |wanted: &&str| {
            self.servers.iter().find(|server| server.address == *wanted).map(|s| s.fingerprint)
        };
        addresses.iter().find_map(at)
    }
}

const HEAD: &str = "# Servers this computer is paired with; `vizflyt pair HOST:PORT` adds one.\n\n";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_a_server_by_typed_or_resolved_address() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        let server = |address: &str, who: &[u8]| KnownServer {
            address: address.to_owned(),
            fingerprint: Fingerprint::of(who),
        };
        Servers::add(&folder, server("lab:4433", b"old")).unwrap();
        Servers::add(&folder, server("10.0.0.2:4433", b"b")).unwrap();
        Servers::add(&folder, server("lab:4433", b"a")).unwrap();
        let known = Servers::read(&folder).unwrap();
        assert_eq!(known.servers.len(), 2);
        let at = |addresses: &[&str]| known.fingerprint(addresses);
        assert_eq!(at(&["lab:4433", "10.0.0.2:4433"]), Some(Fingerprint::of(b"a")));
        assert_eq!(at(&["lab.local:4433", "10.0.0.2:4433"]), Some(Fingerprint::of(b"b")));
        assert_eq!(at(&["lab:4434"]), None);
        assert!(Servers::parse("[[server]]\naddress = 3").unwrap_err().contains("line 2"));
    }
}
