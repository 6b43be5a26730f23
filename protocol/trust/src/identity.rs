//! Identity: a key with its self-signed certificate, created once and stored. Keys are Ed25519, except the page's:
//! browsers do not support Ed25519, so it is ECDSA with P-256.

use std::str::FromStr;

use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use rustls::sign::CertifiedKey;

use crate::fingerprint::Fingerprint;
use crate::folder::{KeyError, KeysFolder};

/// Owner of an identity. One machine may have several.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owner {
    /// The render server.
    Server,
    /// The runtime, or another client of a server.
    Runtime,
    /// The server's page, over HTTPS.
    Page,
}

impl Owner {
    /// Returns the name of the file in the keys folder.
    pub fn file(self) -> &'static str {
        match self {
            Self::Server => "server.key",
            Self::Runtime => "runtime.key",
            Self::Page => "page.key",
        }
    }

    /// Returns the names in the certificate. VizFlyt's clients check only the fingerprint; browsers check the names,
    /// too.
    fn names(self) -> Vec<String> {
        if self != Self::Page {
            return vec!["vizflyt".to_owned()];
        }
        let mut names: Vec<String> = ["localhost", "127.0.0.1", "::1"].map(str::to_owned).into();
        let own = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
        let own = own.trim();
        let is_name = |byte: u8| byte.is_ascii_alphanumeric() || b"-.".contains(&byte);
        if !own.is_empty() && own.len() < 64 && own.bytes().all(is_name) {
            names.extend([own.to_owned(), format!("{own}.local")]);
        }
        names
    }
}

/// Certificate with its key.
#[derive(Debug)]
pub struct Identity {
    /// Certificate in DER.
    pub certificate: CertificateDer<'static>,
    /// Private key in PKCS#8.
    pub key: PrivateKeyDer<'static>,
}

impl Clone for Identity {
    fn clone(&self) -> Self {
        Self { certificate: self.certificate.clone(), key: self.key.clone_key() }
    }
}

impl Identity {
    /// Returns the identity stored in `folder`. Creates it on first use.
    ///
    /// # Errors
    /// Returns an error if the file exists but cannot be used because of its permissions or content. It is not
    /// replaced: a new key would silently invalidate all pairings of the computer.
    pub fn load_or_create(folder: &KeysFolder, owner: Owner) -> Result<Self, KeyError> {
        let name = owner.file();
        if folder.read_secret(name)?.is_none() {
            let text = Self::make(owner).map_err(|what| damaged(folder, owner, &what))?;
            // Another process may have created the file first. Then its key is used, and read below.
            folder.create(name, &text)?;
        }
        let text = folder.read_secret(name)?.unwrap_or_default();
        Self::parse(&text).map_err(|what| damaged(folder, owner, &what))
    }

    /// Returns a new identity for this run only.
    ///
    /// # Errors
    /// Returns an error if the system provides no random numbers.
    pub fn ephemeral() -> Result<Self, String> {
        Self::parse(&Self::make(Owner::Runtime)?)
    }

    /// Returns the fingerprint of the certificate.
    pub fn fingerprint(&self) -> Fingerprint {
        Fingerprint::of(&self.certificate)
    }

    fn make(owner: Owner) -> Result<String, String> {
        let kind = match owner {
            Owner::Server | Owner::Runtime => &rcgen::PKCS_ED25519,
            Owner::Page => &rcgen::PKCS_ECDSA_P256_SHA256,
        };
        let make = || {
            let key = rcgen::KeyPair::generate_for(kind)?;
            let params = rcgen::CertificateParams::new(owner.names())?;
            Ok::<_, rcgen::Error>((params.self_signed(&key)?, key))
        };
        let (certificate, key) = make().map_err(|error| format!("cannot make a key: {error}"))?;
        Ok(format!(
            "{HEAD}{}\n{}{}",
            Fingerprint::of(certificate.der()),
            key.serialize_pem(),
            certificate.pem()
        ))
    }

    fn parse(text: &str) -> Result<Self, String> {
        let stated = text.lines().find_map(|line| line.strip_prefix(HEAD));
        let stated = stated.ok_or("the line with the fingerprint is missing")?;
        let stated = Fingerprint::from_str(stated.trim())?;
        let certificate = CertificateDer::from_pem_slice(text.as_bytes())
            .map_err(|error| format!("no certificate: {error}"))?;
        let key = PrivatePkcs8KeyDer::from_pem_slice(text.as_bytes())
            .map_err(|error| format!("no private key: {error}"))?;
        if Fingerprint::of(&certificate) != stated {
            return Err("the certificate is not the one the file was made with".to_owned());
        }
        let key = PrivateKeyDer::from(key);
        let provider = rustls::crypto::ring::default_provider();
        let chain = vec![certificate.clone()];
        CertifiedKey::from_der(chain, key.clone_key(), &provider)
            .map_err(|error| format!("key and certificate do not belong together: {error}"))?;
        Ok(Self { certificate, key })
    }
}

/// Returns a new secret of 128 random bits, as 32 hexadecimal digits.
///
/// # Errors
/// Returns an error if the system provides no random numbers.
pub fn secret() -> Result<String, String> {
    let mut bytes = [0; 16];
    let random = rustls::crypto::ring::default_provider().secure_random;
    random.fill(&mut bytes).map_err(|_| "the system provides no random numbers".to_owned())?;
    Ok(format!("{:032x}", u128::from_le_bytes(bytes)))
}

fn damaged(folder: &KeysFolder, owner: Owner, what: &str) -> KeyError {
    let what =
        format!("{what}; restore the file, or move it away to start with a new key and pair again");
    KeyError::Damaged { path: folder.file(owner.file()), what }
}

/// First line of a file. Text between PEM sections is ignored by parsers (RFC 7468, section 2).
const HEAD: &str = "VizFlyt key, keep it secret. SHA-256 of the certificate: ";

/// Returns a random number that identifies this run of a program; never 0. The probability of equal numbers is
/// negligible.
pub fn random_instance_id() -> u64 {
    use std::hash::{BuildHasher, RandomState};
    // Keyed with the system's random numbers.
    RandomState::new().hash_one(std::process::id()) | 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> (tempfile::TempDir, KeysFolder) {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        (root, folder)
    }

    #[test]
    fn creates_an_identity_once_and_keeps_it() {
        let (_root, folder) = folder();
        let first = Identity::load_or_create(&folder, Owner::Server).unwrap();
        let again = Identity::load_or_create(&folder, Owner::Server).unwrap();
        assert_eq!(first.fingerprint(), again.fingerprint());
        assert_eq!(first.key, again.key);
        for owner in [Owner::Runtime, Owner::Page] {
            let other = Identity::load_or_create(&folder, owner).unwrap();
            assert_ne!(first.fingerprint(), other.fingerprint());
            let again = Identity::load_or_create(&folder, owner).unwrap();
            assert_eq!(again.fingerprint(), other.fingerprint());
        }
    }

    #[test]
    fn rejects_damaged_files_without_changing_them() {
        let (_root, folder) = folder();
        Identity::load_or_create(&folder, Owner::Server).unwrap();
        let good = folder.read("server.key").unwrap().unwrap();
        let other = Identity::make(Owner::Server).unwrap();
        let swapped = {
            let cut = |text: &str| text.find("-----BEGIN CERT").unwrap();
            format!("{}{}", &other[..cut(&other)], &good[cut(&good)..])
        };
        let mixed =
            swapped.replacen(other.lines().next().unwrap(), good.lines().next().unwrap(), 1);
        let half = &good[..good.len() / 2];
        for bad in ["", "hello", half, &swapped, &mixed] {
            folder.write("server.key", bad).unwrap();
            let error = Identity::load_or_create(&folder, Owner::Server).unwrap_err().to_string();
            assert!(error.contains("server.key") && error.contains("move it away"), "{error}");
            assert_eq!(folder.read("server.key").unwrap().as_deref(), Some(bad));
        }
    }

    #[test]
    fn detects_a_changed_letter() {
        let good = Identity::make(Owner::Server).unwrap();
        let stated = Identity::parse(&good).unwrap();
        for at in 0..good.len() {
            let mut bytes = good.clone().into_bytes();
            bytes[at] ^= 1;
            let Ok(text) = String::from_utf8(bytes) else { continue };
            // A letter of the comment may change, but not the identity.
            if let Ok(found) = Identity::parse(&text) {
                assert_eq!(
                    (found.key, found.certificate),
                    (stated.key.clone_key(), stated.certificate.clone()),
                    "at {at}"
                );
            }
        }
    }
}
