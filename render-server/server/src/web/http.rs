//! HTTP responses, and parsing of JSON requests, for all handlers of the page.

use std::net::SocketAddr;

use axum::body::Bytes;
use axum::extract::rejection::BytesRejection;
use axum::http::{HeaderMap, HeaderName, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::de::DeserializeOwned;
use tracing::warn;

use super::origin;

pub(super) fn file(kind: &'static str, text: &'static str) -> Response {
    guarded(kind, text.into_response())
}

/// Returns an image, or other generated data.
pub(super) fn picture(kind: &'static str, bytes: Bytes) -> Response {
    guarded(kind, bytes.into_response())
}

fn guarded(kind: &'static str, mut response: Response) -> Response {
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(kind));
    for (name, value) in GUARDS {
        headers.insert(HeaderName::from_static(name), HeaderValue::from_static(value));
    }
    response
}

/// Parses the JSON of a request that changes something, or returns the response that rejects it.
pub(super) fn ordered<T: DeserializeOwned>(
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<T, Box<Response>> {
    origin::check(headers).map_err(|refusal| Box::new(refuse(&refusal)))?;
    let body = body.map_err(|rejection| Box::new(rejection.into_response()))?;
    serde_json::from_slice(&body)
        .map_err(|error| Box::new((StatusCode::BAD_REQUEST, error.to_string()).into_response()))
}

/// As [`ordered`], for requests that write files or change what is served: only from a browser on this computer. `why`
/// is the response to others.
pub(super) fn ordered_here<T: DeserializeOwned>(
    from: SocketAddr,
    why: &'static str,
    headers: &HeaderMap,
    body: Result<Bytes, BytesRejection>,
) -> Result<T, Box<Response>> {
    if !from.ip().to_canonical().is_loopback() {
        return Err(Box::new((StatusCode::FORBIDDEN, why).into_response()));
    }
    ordered(headers, body)
}

/// Returns the response to a request of another site.
pub(super) fn refuse(refusal: &origin::Refusal) -> Response {
    warn!("page: {refusal}");
    (StatusCode::FORBIDDEN, refusal.to_string()).into_response()
}

pub(super) const ICON: &str = include_str!("page/icon.svg");

/// No resources of other hosts. No page of another site may frame this one (clickjacking of the stop button).
const GUARDS: [(&str, &str); 5] = [
    (
        "content-security-policy",
        "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; \
         form-action 'none'",
    ),
    ("x-frame-options", "DENY"),
    ("x-content-type-options", "nosniff"),
    ("referrer-policy", "no-referrer"),
    ("cache-control", "no-cache"),
];
