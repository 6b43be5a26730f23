//! The server's identity: a self-signed certificate whose SHA-256 the runtime pins.
//!
//! Made afresh at every start; the fingerprint is printed and shown, never trusted from the net.

use anyhow::{Context, Result};
use rustls::pki_types::{CertificateDer, PrivateKeyDer, PrivatePkcs8KeyDer};
use sha2::{Digest, Sha256};

/// A certificate with its key.
#[derive(Debug)]
pub struct Identity {
    /// DER.
    pub certificate: CertificateDer<'static>,
    /// PKCS#8.
    pub key: PrivateKeyDer<'static>,
}

impl Identity {
    /// Makes a fresh one.
    pub fn generate() -> Result<Self> {
        let made = rcgen::generate_simple_self_signed(vec!["vizflyt".to_owned()])
            .context("cannot make the server's certificate")?;
        Ok(Self {
            certificate: made.cert.der().clone(),
            key: PrivatePkcs8KeyDer::from(made.signing_key.serialize_der()).into(),
        })
    }

    /// Returns the SHA-256 of the DER certificate, as 64 hexadecimal digits.
    pub fn fingerprint(&self) -> String {
        fingerprint(&self.certificate)
    }
}

/// Returns the SHA-256 of a DER certificate, as 64 hexadecimal digits.
pub fn fingerprint(certificate: &[u8]) -> String {
    use std::fmt::Write;
    Sha256::digest(certificate).iter().fold(String::with_capacity(64), |mut text, byte| {
        // Why: writing to a String cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fingerprints_are_sha_256_and_identities_differ() {
        let empty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
        assert_eq!(fingerprint(b""), empty);
        let (one, two) = (Identity::generate().unwrap(), Identity::generate().unwrap());
        assert_ne!(one.fingerprint(), two.fingerprint());
    }
}
