//! Mutual TLS 1.3 between self-signed certificates.
//!
//! TLS proves that the other side holds the key of the certificate it shows; whether that
//! certificate may do anything is decided afterwards, by its fingerprint. Sessions are never
//! resumed: each connection proves it again.

use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use rustls::client::Resumption;
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, WebPkiSupportedAlgorithms, verify_tls13_signature};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName, UnixTime};
use rustls::server::danger::{ClientCertVerified, ClientCertVerifier};
use rustls::{
    CertificateError, ClientConfig, DigitallySignedStruct, DistinguishedName, Error, ServerConfig,
    SignatureScheme,
};

use crate::{Fingerprint, Identity};

/// Returns the server's side: any client that holds a key may finish the handshake.
pub fn server_config(identity: &Identity, alpn: &[&[u8]]) -> Result<ServerConfig, Error> {
    let provider = provider();
    let mut config = ServerConfig::builder_with_provider(provider.clone())
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_client_cert_verifier(Arc::new(AnyClient(provider)))
        .with_single_cert(vec![identity.certificate.clone()], identity.key.clone_key())?;
    config.send_tls13_tickets = 0;
    config.alpn_protocols = alpn.iter().map(|name| name.to_vec()).collect();
    Ok(config)
}

/// Returns the page's side: browsers show no certificate, and speak HTTP/1.1.
///
/// # Errors
/// A key that is not the certificate's, or of a kind that TLS does not know.
pub fn page_config(
    chain: Vec<CertificateDer<'static>>,
    key: PrivateKeyDer<'static>,
) -> Result<ServerConfig, Error> {
    let mut config = ServerConfig::builder_with_provider(provider())
        .with_protocol_versions(&[&rustls::version::TLS13])?
        .with_no_client_auth()
        .with_single_cert(chain, key)?;
    config.alpn_protocols = vec![b"http/1.1".to_vec()];
    Ok(config)
}

/// As [`page_config`], from PEM files; with the fingerprint of the certificate.
///
/// # Errors
/// What is wrong with which file.
pub fn page_config_of_files(
    certificate: &Path,
    key: &Path,
) -> Result<(ServerConfig, Fingerprint), String> {
    let wrong = |path: &Path, what: String| format!("{}: {what}", path.display());
    let chain: Result<Vec<_>, _> =
        CertificateDer::pem_file_iter(certificate).and_then(Iterator::collect);
    let chain = chain.map_err(|error| wrong(certificate, format!("no certificate: {error}")))?;
    let Some(first) = chain.first() else {
        return Err(wrong(certificate, "no certificate in it (PEM)".to_owned()));
    };
    let fingerprint = Fingerprint::of(first);
    let der = PrivateKeyDer::from_pem_file(key)
        .map_err(|error| wrong(key, format!("no private key: {error}")))?;
    let config = page_config(chain, der).map_err(|error| wrong(key, error.to_string()))?;
    Ok((config, fingerprint))
}

/// Which server a client takes for its own.
#[derive(Clone, Debug)]
pub struct Pin {
    expected: Option<Fingerprint>,
    found: Arc<Mutex<Option<Fingerprint>>>,
    provider: Arc<CryptoProvider>,
}

impl Pin {
    /// Accepts the one server of this fingerprint.
    pub fn to(expected: Fingerprint) -> Self {
        Self { expected: Some(expected), found: Arc::default(), provider: provider() }
    }

    /// Accepts any server, for pairing: who it is must be proved by the code.
    pub fn none() -> Self {
        Self { expected: None, found: Arc::default(), provider: provider() }
    }

    /// Returns who answered, accepted or not.
    pub fn found(&self) -> Option<Fingerprint> {
        *self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns who answered in place of the expected one.
    pub fn mismatch(&self) -> Option<Fingerprint> {
        self.found().filter(|found| self.expected.is_some_and(|expected| expected != *found))
    }

    /// Returns the client's side.
    pub fn client_config(&self, identity: &Identity, alpn: &[u8]) -> Result<ClientConfig, Error> {
        let mut config = ClientConfig::builder_with_provider(self.provider.clone())
            .with_protocol_versions(&[&rustls::version::TLS13])?
            .dangerous() // Why: the certificate is pinned below, which is stricter than a CA.
            .with_custom_certificate_verifier(Arc::new(self.clone()))
            .with_client_auth_cert(vec![identity.certificate.clone()], identity.key.clone_key())?;
        config.resumption = Resumption::disabled();
        config.alpn_protocols = vec![alpn.to_vec()];
        Ok(config)
    }
}

impl ServerCertVerifier for Pin {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _server_name: &ServerName<'_>,
        _ocsp_response: &[u8],
        _now: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        let found = Fingerprint::of(end_entity);
        *self.found.lock().unwrap_or_else(PoisonError::into_inner) = Some(found);
        if self.expected.is_none_or(|expected| expected == found) {
            Ok(ServerCertVerified::assertion())
        } else {
            Err(CertificateError::ApplicationVerificationFailure.into())
        }
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(no_tls12())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, cert, dss, algorithms(&self.provider))
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        SCHEMES.to_vec()
    }
}

/// Takes any certificate whose key the client proves to hold.
#[derive(Debug)]
struct AnyClient(Arc<CryptoProvider>);

impl ClientCertVerifier for AnyClient {
    fn root_hint_subjects(&self) -> &[DistinguishedName] {
        &[]
    }

    fn verify_client_cert(
        &self,
        _end_entity: &CertificateDer<'_>,
        _intermediates: &[CertificateDer<'_>],
        _now: UnixTime,
    ) -> Result<ClientCertVerified, Error> {
        Ok(ClientCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _message: &[u8],
        _cert: &CertificateDer<'_>,
        _dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(no_tls12())
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        cert: &CertificateDer<'_>,
        dss: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        verify_tls13_signature(message, cert, dss, algorithms(&self.0))
    }

    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        SCHEMES.to_vec()
    }
}

fn provider() -> Arc<CryptoProvider> {
    Arc::new(rustls::crypto::ring::default_provider())
}

fn algorithms(provider: &CryptoProvider) -> &WebPkiSupportedAlgorithms {
    &provider.signature_verification_algorithms
}

fn no_tls12() -> Error {
    Error::General("TLS 1.2 is not spoken here".to_owned())
}

/// All our keys are of one kind; what is never used is not offered.
const SCHEMES: [SignatureScheme; 1] = [SignatureScheme::ED25519];

#[cfg(test)]
mod tests {
    use super::*;
    use rustls::{ClientConnection, ServerConnection};

    /// Shakes hands in memory; returns whom each side saw.
    fn handshake(
        client: ClientConfig,
        server: ServerConfig,
    ) -> Result<Option<Fingerprint>, String> {
        let mut client =
            ClientConnection::new(Arc::new(client), "vizflyt".try_into().unwrap()).unwrap();
        let mut server = ServerConnection::new(Arc::new(server)).unwrap();
        for _ in 0..8 {
            let mut wire = Vec::new();
            while client.wants_write() {
                client.write_tls(&mut wire).unwrap();
            }
            server.read_tls(&mut wire.as_slice()).unwrap();
            server.process_new_packets().map_err(|error| format!("server: {error}"))?;
            wire.clear();
            while server.wants_write() {
                server.write_tls(&mut wire).unwrap();
            }
            client.read_tls(&mut wire.as_slice()).unwrap();
            client.process_new_packets().map_err(|error| format!("client: {error}"))?;
        }
        assert!(!client.is_handshaking() && !server.is_handshaking());
        Ok(server.peer_certificates().map(|chain| Fingerprint::of(&chain[0])))
    }

    #[test]
    fn each_side_learns_who_the_other_is() {
        let [one, two] = [(); 2].map(|()| Identity::ephemeral().unwrap());
        let server = || server_config(&one, &[b"x"]).unwrap();
        let pin = Pin::to(one.fingerprint());
        let seen = handshake(pin.client_config(&two, b"x").unwrap(), server()).unwrap();
        assert_eq!(seen, Some(two.fingerprint()));
        assert_eq!((pin.found(), pin.mismatch()), (Some(one.fingerprint()), None));

        let wrong = Pin::to(two.fingerprint());
        let error = handshake(wrong.client_config(&two, b"x").unwrap(), server()).unwrap_err();
        assert!(error.starts_with("client:"), "{error}");
        assert_eq!(wrong.mismatch(), Some(one.fingerprint()));
        let any = Pin::none();
        handshake(any.client_config(&two, b"x").unwrap(), server()).unwrap();
        assert_eq!((any.found(), any.mismatch()), (Some(one.fingerprint()), None));
        assert!(
            handshake(any.client_config(&two, b"y").unwrap(), server()).is_err(),
            "another ALPN"
        );
    }

    /// Shows the certificate of a paired client without its key.
    #[derive(Debug)]
    struct StolenCertificate(Arc<rustls::sign::CertifiedKey>);

    impl rustls::client::ResolvesClientCert for StolenCertificate {
        fn resolve(
            &self,
            _: &[&[u8]],
            _: &[SignatureScheme],
        ) -> Option<Arc<rustls::sign::CertifiedKey>> {
            Some(self.0.clone())
        }

        fn has_certs(&self) -> bool {
            true
        }
    }

    #[test]
    fn a_client_without_a_certificate_or_with_a_stolen_one_is_refused() {
        let [one, two, three] = [(); 3].map(|()| Identity::ephemeral().unwrap());
        let pin = Pin::to(one.fingerprint());
        let builder = || {
            ClientConfig::builder_with_provider(provider())
                .with_protocol_versions(&[&rustls::version::TLS13])
                .unwrap()
                .dangerous()
                .with_custom_certificate_verifier(Arc::new(pin.clone()))
        };
        let server = || server_config(&one, &[]).unwrap();
        let error = handshake(builder().with_no_client_auth(), server()).unwrap_err();
        assert!(error.contains("peer sent no certificates"), "{error}");
        let key = provider().key_provider.load_private_key(three.key.clone_key()).unwrap();
        let stolen = rustls::sign::CertifiedKey::new(vec![two.certificate.clone()], key);
        let thief =
            builder().with_client_cert_resolver(Arc::new(StolenCertificate(Arc::new(stolen))));
        let error = handshake(thief, server()).unwrap_err();
        assert!(error.starts_with("server:") && error.contains("BadSignature"), "{error}");
    }
}
