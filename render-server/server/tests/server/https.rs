//! The page over HTTPS, with a certificate that the server creates.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::sync::{Arc, Mutex};

use crate::support::{PATIENCE, Server, write_arena};
use rustls::client::danger::{HandshakeSignatureValid, ServerCertVerified, ServerCertVerifier};
use rustls::crypto::{CryptoProvider, ring, verify_tls13_signature};
use rustls::pki_types::{CertificateDer, ServerName, UnixTime};
use rustls::{ClientConfig, ClientConnection, DigitallySignedStruct, Error, SignatureScheme};
use vizflyt_trust::Fingerprint;

/// Accepts any certificate, like a person who clicks the warning away, and stores it.
#[derive(Debug)]
struct Click {
    provider: CryptoProvider,
    seen: Mutex<Option<Fingerprint>>,
}

impl ServerCertVerifier for Click {
    fn verify_server_cert(
        &self,
        end_entity: &CertificateDer<'_>,
        _: &[CertificateDer<'_>],
        _: &ServerName<'_>,
        _: &[u8],
        _: UnixTime,
    ) -> Result<ServerCertVerified, Error> {
        *self.seen.lock().unwrap() = Some(Fingerprint::of(end_entity));
        Ok(ServerCertVerified::assertion())
    }

    fn verify_tls12_signature(
        &self,
        _: &[u8],
        _: &CertificateDer<'_>,
        _: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        Err(Error::General("TLS 1.3 alone is spoken".to_owned()))
    }

    fn verify_tls13_signature(
        &self,
        message: &[u8],
        certificate: &CertificateDer<'_>,
        signed: &DigitallySignedStruct,
    ) -> Result<HandshakeSignatureValid, Error> {
        let algorithms = &self.provider.signature_verification_algorithms;
        verify_tls13_signature(message, certificate, signed, algorithms)
    }

    /// Schemes of browsers: without Ed25519.
    fn supported_verify_schemes(&self) -> Vec<SignatureScheme> {
        vec![SignatureScheme::ECDSA_NISTP256_SHA256, SignatureScheme::RSA_PSS_SHA256]
    }
}

/// Sends a request over TLS; returns the answer and the fingerprint of the shown certificate.
fn ask(address: SocketAddr, request: &str) -> (String, Fingerprint) {
    let provider = ring::default_provider();
    let click = Arc::new(Click { provider: provider.clone(), seen: Mutex::default() });
    let mut config = ClientConfig::builder_with_provider(Arc::new(provider))
        .with_protocol_versions(&[&rustls::version::TLS13])
        .unwrap()
        .dangerous()
        .with_custom_certificate_verifier(click.clone())
        .with_no_client_auth();
    config.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    let name = ServerName::try_from("localhost").unwrap();
    let session = ClientConnection::new(Arc::new(config), name).unwrap();
    let stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut stream = rustls::StreamOwned::new(session, stream);
    write!(stream, "{request} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n").unwrap();
    let mut answer = Vec::new();
    // A missing close_notify of TLS is not an error: the answer is complete.
    let _ = stream.read_to_end(&mut answer);
    let seen = click.seen.lock().unwrap().expect("a certificate");
    (String::from_utf8_lossy(&answer).into_owned(), seen)
}

#[test]
fn the_page_is_served_over_https_with_a_created_certificate() {
    let folder = tempfile::tempdir().unwrap();
    let options = ["--tls", "auto", "--print-page-keys"];
    let server = Server::start(&write_arena(folder.path(), ""), &options);
    let page = server.ready["http"].as_str().unwrap();
    assert!(page.starts_with("https://"), "{page}");
    let (answer, seen) = ask(server.http, "GET /");
    assert!(answer.starts_with("HTTP/1.1 200") && answer.contains("<title>"), "{answer}");
    assert_eq!(server.ready["page_certificate"], seen.to_string().as_str());
    assert_ne!(seen, server.fingerprint(), "runtimes pin another");
    let link = server.line(|line| line["page_key"]["link"].as_str().map(str::to_owned));
    let (answer, _) = ask(server.http, &format!("GET {}", link.strip_prefix(page).unwrap()));
    let cookie = answer.lines().find(|line| line.starts_with("set-cookie: ")).unwrap();
    assert!(answer.starts_with("HTTP/1.1 303") && cookie.ends_with("; Secure"), "{answer}");
    // A request of http:// gets an answer that names HTTPS.
    let (status, answer) = crate::support::http(server.http, "GET / HTTP/1.1");
    assert!(status == 400 && answer.contains("this page is HTTPS"), "{answer}");
}
