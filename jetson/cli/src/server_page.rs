//! HTTP client for the page of a running server: plain HTTP, one request per connection.

use std::io::{Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use anyhow::{Context, Result, bail};

/// Address of a page, and the key that opens it from another computer.
#[derive(Clone, Debug)]
pub(crate) struct ServerPage<'a> {
    url: &'a str,
    key: Option<&'a str>,
}

impl<'a> ServerPage<'a> {
    /// Returns the page at `url`, as `http://HOST:PORT`.
    pub(crate) fn at(url: &'a str) -> Self {
        Self { url, key: None }
    }

    /// Returns the page with the key of `/enter?key=KEY`. On the server's own computer no key is
    /// needed.
    pub(crate) fn with_key(self, key: Option<&'a str>) -> Self {
        Self { key, ..self }
    }

    /// Requests `path`; returns status and body.
    ///
    /// # Errors
    /// If the address is invalid or no server replies.
    pub(crate) fn get(&self, path: &str) -> Result<(u16, Vec<u8>)> {
        self.ask(&format!("GET {path}"), "", "")
    }

    /// Posts `json` to `path`; returns status and body.
    ///
    /// # Errors
    /// As [`Self::get`].
    pub(crate) fn post(&self, path: &str, json: &str) -> Result<(u16, Vec<u8>)> {
        let mut heads =
            format!("Origin: http://{}\r\nContent-Type: application/json\r\n", self.host()?);
        if self.key.is_some() {
            // Changes require the token that belongs to the key.
            let (_, session) = self.get("/api/session")?;
            let session: serde_json::Value = serde_json::from_slice(&session).unwrap_or_default();
            if let Some(token) = session["token"].as_str() {
                heads = format!("{heads}X-VizFlyt-Token: {token}\r\n");
            }
        }
        self.ask(&format!("POST {path}"), &heads, json)
    }

    /// Returns the page's host and port.
    fn host(&self) -> Result<&'a str> {
        let url = self.url;
        let host = url.strip_prefix("http://").unwrap_or(url).trim_end_matches('/');
        if host.contains('/') {
            bail!("'{url}' is not the address of a page; write http://HOST:PORT");
        }
        Ok(host)
    }

    fn ask(&self, request: &str, heads: &str, body: &str) -> Result<(u16, Vec<u8>)> {
        let (url, host) = (self.url, self.host()?);
        let with_port = if host.rsplit(']').next().is_some_and(|tail| tail.contains(':')) {
            host.to_owned()
        } else {
            format!("{host}:80")
        };
        let no_server = || {
            format!(
                "no server replies at {url}; start `vizflyt serve` or `vizflyt demo`, and give the page \
                 it prints with --page"
            )
        };
        let mut addresses = with_port.to_socket_addrs().with_context(no_server)?;
        let address = addresses.next().with_context(no_server)?;
        let mut stream = TcpStream::connect_timeout(&address, PATIENCE).with_context(no_server)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        let cookie = match self.key {
            Some(key) if key.bytes().all(|byte| byte.is_ascii_alphanumeric()) => {
                format!("Cookie: vizflyt_key={key}\r\n")
            }
            Some(_) => {
                bail!(
                    "a page's key consists of letters and digits, as in the address /enter?key=KEY"
                )
            }
            None => String::new(),
        };
        // HTTP/1.0: the response ends with the connection.
        write!(
            stream,
            "{request} HTTP/1.0\r\nHost: {host}\r\n{cookie}{heads}Content-Length: {}\r\n\r\n{body}",
            body.len()
        )
        .with_context(no_server)?;
        let mut answer = Vec::new();
        stream.take(MAX_BYTES).read_to_end(&mut answer).with_context(no_server)?;
        parse(&answer).with_context(no_server)
    }
}

/// Returns status and body of a response.
fn parse(answer: &[u8]) -> Option<(u16, Vec<u8>)> {
    let end = answer.windows(4).position(|window| window == b"\r\n\r\n")?;
    let head = std::str::from_utf8(&answer[..end]).ok()?;
    let status = head.split(' ').nth(1)?.parse().ok()?;
    Some((status, answer[end + 4..].to_vec()))
}

/// Timeout for a response within the lab.
const PATIENCE: Duration = Duration::from_secs(3);
/// Maximum size of a response; a lab day's report is the largest. [bytes]
const MAX_BYTES: u64 = 8 << 20;

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn rejects_an_invalid_address() {
        let error = ServerPage::at("http://127.0.0.1:1").get("/").unwrap_err();
        assert!(error.to_string().contains("no server replies at http://127.0.0.1:1"), "{error}");
        let error = ServerPage::at("http://127.0.0.1:1/page").get("/").unwrap_err();
        assert!(error.to_string().contains("write http://HOST:PORT"), "{error}");
    }

    #[test]
    fn splits_a_response_into_status_and_body() {
        assert_eq!(parse(b"HTTP/1.1 200 OK\r\nA: b\r\n\r\n\x00\xff"), Some((200, vec![0, 255])));
        assert_eq!(parse(b"HTTP/1.1 200 OK\r\n"), None);
        assert_eq!(parse(b"SSH-2.0\r\n\r\n"), None);
    }

    proptest! {
        #[test]
        fn rejects_noise_without_panic(bytes in prop::collection::vec(any::<u8>(), 0..80)) {
            let is_answer = parse(&bytes).is_some();
            prop_assert!(!is_answer || bytes.windows(4).any(|window| window == b"\r\n\r\n"));
        }
    }
}
