//! Mutual TLS 1.3 between self-signed certificates.
//!
//! TLS proves that the peer holds the key of its certificate. The rights of that certificate are checked afterwards, by
//! its fingerprint. Sessions are never resumed, so that each connection proves the key again.

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

/// Returns the server's configuration. Any client that holds the key of its certificate can complete the handshake.
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

/// Returns the configuration of the page's server, without client certificates and with HTTP/1.1.
///
/// # Errors
/// Returns an error if the key does not match the certificate or has an unsupported type.
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

/// Like [`page_config`], from PEM files. Also returns the fingerprint of the certificate.
///
/// # Errors
/// Returns a message with the file and the error.
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

/// Server that a client accepts, and the server that it found.
#[derive(Clone, Debug)]
pub struct Pin {
    expected: Option<Fingerprint>,
    found: Arc<Mutex<Option<Fingerprint>>>,
    provider: Arc<CryptoProvider>,
}

impl Pin {
    /// Accepts only the server with this fingerprint.
    pub fn to(expected: Fingerprint) -> Self {
        Self { expected: Some(expected), found: Arc::default(), provider: provider() }
    }

    /// Accepts any server, for pairing. The code must then prove the server's identity.
    pub fn none() -> Self {
        Self { expected: None, found: Arc::default(), provider: provider() }
    }

    /// Returns the fingerprint of the server that replied, accepted or not.
    pub fn found(&self) -> Option<Fingerprint> {
        *self.found.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the fingerprint of the server that replied, if it is not the expected one.
    pub fn mismatch(&self) -> Option<Fingerprint> {
        self.found().filter(|found| self.expected.is_some_and(|expected| expected != *found))
    }

    /// Returns the client's configuration.
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

/// Accepts any certificate if the client proves that it holds the key.
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
    Error::General("TLS 1.2 is not supported".to_owned())
}

/// The keys of servers and clients are Ed25519 (the browser page's is not used here); unused schemes are not offered.
const SCHEMES: [SignatureScheme; 1] = [SignatureScheme::ED25519];

#[cfg(test)]
mod tests {
    use super::*;
    use rustls::{ClientConnection, ServerConnection};

    /// Performs a handshake in memory. Returns the fingerprint of the client that the server sees.
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
    fn each_side_gets_the_fingerprint_of_the_other() {
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

    /// Presents the certificate of a paired client without its key.
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
    fn rejects_a_client_without_a_certificate_or_with_a_stolen_one() {
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
