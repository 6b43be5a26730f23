//! HTTPS for the page: its certificate, and addresses on which plain HTTP is rejected.
//!
//! `--tls auto` creates a certificate once and stores it with the server's keys, so that browsers need to accept it
//! only once. Browsers do not support Ed25519, so it differs from the certificate that runtimes pin. Only TLS 1.3 is
//! supported.

use std::net::{IpAddr, SocketAddr};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::time::timeout;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::server::TlsStream;
use tracing::warn;
use vizflyt_trust::{Fingerprint, Identity, KeysFolder, Owner, tls};

use crate::stream::rate_control::is_near;

/// Loaded certificate of the page.
#[derive(Clone)]
pub(crate) struct PageTls {
    acceptor: TlsAcceptor,
    fingerprint: Fingerprint,
}

impl std::fmt::Debug for PageTls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "PageTls({})", self.fingerprint)
    }
}

impl PageTls {
    /// Loads the files of `--tls` and `--tls-key`; `None` if neither is set.
    ///
    /// # Errors
    /// If certificate or key cannot be used, or one of them is missing.
    pub(crate) fn open(
        certificate: Option<&Path>,
        key: Option<&Path>,
        folder: &KeysFolder,
    ) -> Result<Option<Self>> {
        let identity = match (certificate, key) {
            (None, None) => return Ok(None),
            (None, Some(_)) => bail!("--tls-key needs --tls with the certificate's file"),
            (Some(auto), None) if auto.as_os_str() == "auto" => {
                return Self::of_identity(&Identity::load_or_create(folder, Owner::Page)?)
                    .map(Some);
            }
            (Some(auto), Some(_)) if auto.as_os_str() == "auto" => {
                bail!(
                    "--tls auto makes its own key; leave --tls-key out, or name a certificate's file"
                )
            }
            (Some(file), None) => {
                bail!("--tls {} needs --tls-key with the key's file", file.display())
            }
            (Some(certificate), Some(key)) => (certificate, key),
        };
        let (certificate, key) = identity;
        let config = tls::page_config_of_files(certificate, key).map_err(anyhow::Error::msg)?;
        Ok(Some(Self { acceptor: TlsAcceptor::from(Arc::new(config.0)), fingerprint: config.1 }))
    }

    fn of_identity(identity: &Identity) -> Result<Self> {
        let config = tls::page_config(vec![identity.certificate.clone()], identity.key.clone_key())
            .context("the page's key cannot be used for TLS")?;
        let acceptor = TlsAcceptor::from(Arc::new(config));
        Ok(Self { acceptor, fingerprint: identity.fingerprint() })
    }

    /// Returns the SHA-256 of the certificate, which browsers show as well.
    pub(crate) fn fingerprint(&self) -> Fingerprint {
        self.fingerprint
    }

    /// Performs the TLS handshake. A browser that sends plain HTTP receives an answer that names `https://`.
    ///
    /// # Errors
    /// Reason of a failed handshake, for the log.
    pub(super) async fn accept(&self, mut stream: TcpStream) -> Result<TlsStream<TcpStream>> {
        let shaken = timeout(HANDSHAKE_WITHIN, async {
            let mut first = [0];
            stream.peek(&mut first).await?;
            if first[0].is_ascii_alphabetic() {
                stream.write_all(PLAIN.as_bytes()).await?;
                stream.shutdown().await?;
                // Unread data would reset the connection before the browser has read the answer.
                while stream.read(&mut [0; 4096]).await? > 0 {}
                bail!("plain HTTP on an HTTPS port");
            }
            Ok(self.acceptor.accept(stream).await?)
        });
        shaken.await.context("no TLS handshake within 5 s")?
    }
}

/// Rejects plain HTTP on a public address, unless `is_asked_for`; warns on a private one.
///
/// # Errors
/// Names the address, and what to do.
pub(crate) fn check_plain(address: SocketAddr, is_asked_for: bool) -> Result<()> {
    if address.ip().is_loopback() {
        return Ok(());
    }
    if let Some(public) = public_among(&reached_by(address.ip()))
        && !is_asked_for
    {
        bail!(
            "--http {address} is reached at the public address {public}, and plain HTTP lets everyone on the \
             way read keys and pictures: add --tls auto for HTTPS, use --http 127.0.0.1:{}, or insist \
             with --plain-http",
            address.port()
        );
    }
    warn!(
        "the page at {address} asks for keys, but plain HTTP lets everyone on that network read \
         them; add --tls auto, or use --http 127.0.0.1:{} to keep it to this computer",
        address.port()
    );
    Ok(())
}

/// Returns the addresses that reach a socket bound to `address`.
fn reached_by(address: IpAddr) -> Vec<IpAddr> {
    if !address.is_unspecified() {
        return vec![address];
    }
    let Ok(interfaces) = nix::ifaddrs::getifaddrs() else { return Vec::new() };
    let own = interfaces.filter_map(|interface| {
        let address = interface.address?;
        let v4 = address.as_sockaddr_in().map(|v4| IpAddr::from(v4.ip()));
        v4.or_else(|| address.as_sockaddr_in6().map(|v6| IpAddr::from(v6.ip())))
    });
    // The unspecified IPv6 address accepts IPv4 too.
    own.filter(|own| address.is_ipv6() || own.is_ipv4()).collect()
}

/// Returns the first address that is neither loopback nor private (RFC 1918, RFC 4193, link-local).
fn public_among(addresses: &[IpAddr]) -> Option<IpAddr> {
    addresses.iter().copied().find(|address| !is_near(*address))
}

const HANDSHAKE_WITHIN: Duration = Duration::from_secs(5);
const PLAIN: &str = "HTTP/1.1 400 Bad Request\r\nContent-Type: text/plain\r\nConnection: close\r\n\
                     Content-Length: 45\r\n\r\nthis page is HTTPS: open it with https://...\n";

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejects_plain_http_only_on_public_addresses() {
        let check = |address: &str, asked: bool| check_plain(address.parse().unwrap(), asked);
        for private in
            ["127.0.0.1:8080", "[::1]:8080", "192.168.1.4:80", "10.1.2.3:80", "[fd00::2]:80"]
        {
            assert!(check(private, false).is_ok(), "{private}");
        }
        for public in ["203.0.113.5:8080", "[2001:db8::1]:8080"] {
            let error = check(public, false).unwrap_err().to_string();
            for part in ["--tls auto", "--plain-http", "127.0.0.1:8080"] {
                assert!(error.contains(part), "{error}");
            }
            assert!(check(public, true).is_ok());
        }
        let all = reached_by("0.0.0.0".parse().unwrap());
        assert!(all.contains(&"127.0.0.1".parse().unwrap()), "{all:?}");
        assert!(all.iter().all(IpAddr::is_ipv4), "{all:?}");
    }

    #[test]
    fn keeps_the_certificate_and_rejects_incomplete_settings() {
        let root = tempfile::tempdir().unwrap();
        let folder = KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        let open = |tls: Option<&str>, key: Option<&str>| {
            PageTls::open(tls.map(Path::new), key.map(Path::new), &folder)
        };
        assert!(open(None, None).unwrap().is_none());
        let first = open(Some("auto"), None).unwrap().unwrap().fingerprint();
        assert_eq!(open(Some("auto"), None).unwrap().unwrap().fingerprint(), first);
        for (tls, key, part) in [
            (None, Some("k"), "--tls-key needs --tls"),
            (Some("c"), None, "needs --tls-key"),
            (Some("auto"), Some("k"), "makes its own key"),
            (Some("nowhere.pem"), Some("k"), "nowhere.pem"),
        ] {
            let error = format!("{:#}", open(tls, key).unwrap_err());
            assert!(error.contains(part), "{error}");
        }
        // The same certificate from files.
        let text = std::fs::read_to_string(folder.file("page.key")).unwrap();
        let file = root.path().join("both.pem");
        std::fs::write(&file, text).unwrap();
        let file = file.to_str();
        assert_eq!(open(file, file).unwrap().unwrap().fingerprint(), first);
    }

    #[test]
    fn the_answer_to_plain_http_is_complete() {
        let (head, body) = PLAIN.split_once("\r\n\r\n").unwrap();
        assert!(head.contains(&format!("Content-Length: {}", body.len())));
    }
}
