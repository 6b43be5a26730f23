//! Check of `Origin` and `Host`: only a page of this server may open the WebSocket or press the button.
//!
//! A browser sends `Origin` with both; it must match the host and port of the request. This check does not detect DNS
//! rebinding (a foreign name that resolves to this address), so the host must also be an address, `localhost`, or the
//! name of this computer.

use std::net::IpAddr;

use axum::http::{HeaderMap, HeaderName, header};

/// Reason for which a request is rejected.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum Refusal {
    /// A header is missing, duplicated, or not text.
    #[error("the {0} header is missing or malformed; open the page itself, or send the header")]
    Missing(&'static str),
    /// The request comes from another page.
    #[error("a page of '{origin}' may not act on '{host}'; open the page at '{host}' itself")]
    Foreign {
        /// Origin of the page.
        origin: String,
        /// Host of the request.
        host: String,
    },
    /// The host is not a name of this computer.
    #[error("'{0}' is not a name of this computer; open the page by address or as localhost")]
    Name(String),
}

/// Checks the headers of a request that changes something or opens a WebSocket.
pub(crate) fn check(headers: &HeaderMap) -> Result<(), Refusal> {
    check_as(headers, own_name().trim())
}

/// Checks only that the host is a name or address of this computer. Browsers send no `Origin` with same-origin reads.
pub(crate) fn check_host(headers: &HeaderMap) -> Result<(), Refusal> {
    let host = only(headers, &header::HOST).ok_or(Refusal::Missing("Host"))?;
    check_name(host, own_name().trim())
}

/// Checks a request that browsers also make without `Origin`, for example for an opened link. An `Origin` that is
/// present must be this server's.
pub(crate) fn check_navigation(headers: &HeaderMap) -> Result<(), Refusal> {
    if headers.contains_key(header::ORIGIN) { check(headers) } else { check_host(headers) }
}

fn own_name() -> String {
    std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default()
}

fn check_as(headers: &HeaderMap, own_name: &str) -> Result<(), Refusal> {
    let host = only(headers, &header::HOST).ok_or(Refusal::Missing("Host"))?;
    let origin = only(headers, &header::ORIGIN).ok_or(Refusal::Missing("Origin"))?;
    let from = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"));
    if from.is_none_or(|from| !from.eq_ignore_ascii_case(host)) {
        return Err(Refusal::Foreign { origin: origin.to_owned(), host: host.to_owned() });
    }
    check_name(host, own_name)
}

fn check_name(host: &str, own_name: &str) -> Result<(), Refusal> {
    let name = without_port(host);
    let bare = name.trim_start_matches('[').trim_end_matches(']');
    let own = |candidate: &str| {
        !own_name.is_empty()
            && (candidate.eq_ignore_ascii_case(own_name)
                || candidate
                    .to_ascii_lowercase()
                    .strip_suffix(".local")
                    .is_some_and(|short| short.eq_ignore_ascii_case(own_name)))
    };
    if bare.parse::<IpAddr>().is_ok() || name.eq_ignore_ascii_case("localhost") || own(name) {
        Ok(())
    } else {
        Err(Refusal::Name(name.to_owned()))
    }
}

fn only<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    let mut values = headers.get_all(name).iter();
    match (values.next(), values.next()) {
        (Some(value), None) => value.to_str().ok(),
        _ => None,
    }
}

fn without_port(host: &str) -> &str {
    match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check(host: &str, origin: &str, expected: bool) {
        let mut headers = HeaderMap::new();
        if !host.is_empty() {
            headers.insert(header::HOST, host.parse().unwrap());
        }
        if !origin.is_empty() {
            headers.insert(header::ORIGIN, origin.parse().unwrap());
        }
        let found = check_as(&headers, "lab-pc");
        assert_eq!(found.is_ok(), expected, "{host} from {origin}: {found:?}");
    }

    #[test]
    fn accepts_requests_only_from_own_pages() {
        check("127.0.0.1:8080", "http://127.0.0.1:8080", true);
        check("localhost:8080", "http://localhost:8080", true);
        check("[::1]:8080", "http://[::1]:8080", true);
        check("LAB-PC:8080", "http://lab-pc:8080", true);
        check("lab-pc.local:8080", "http://lab-pc.local:8080", true);
        check("192.168.1.4", "https://192.168.1.4", true);
        // Other page, other port, no header, opaque origin.
        check("127.0.0.1:8080", "http://evil.example", false);
        check("127.0.0.1:8080", "http://127.0.0.1:8081", false);
        check("127.0.0.1:8080", "", false);
        check("127.0.0.1:8080", "null", false);
        check("", "http://127.0.0.1:8080", false);
        // DNS rebinding: a foreign name resolves to this server.
        check("evil.example:8080", "http://evil.example:8080", false);
    }

    #[test]
    fn rejects_a_duplicate_header() {
        let mut headers = HeaderMap::new();
        headers.insert(header::HOST, "127.0.0.1".parse().unwrap());
        headers.append(header::ORIGIN, "http://127.0.0.1".parse().unwrap());
        headers.append(header::ORIGIN, "http://evil.example".parse().unwrap());
        assert_eq!(check_as(&headers, ""), Err(Refusal::Missing("Origin")));
    }
}
