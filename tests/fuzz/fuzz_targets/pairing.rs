//! Pairing: messages of both sides to both state machines, and the files that people edit.
#![no_main]
use std::time::Instant;

use libfuzzer_sys::fuzz_target;
use vizflyt_protocol::messages::{Grant, PairingReply, PairingRequest};
use vizflyt_protocol::packet::framing::{Deframer, FramingError};
use vizflyt_trust::pairing::{Binding, Code, PairingClient, PairingServer};
use vizflyt_trust::{Fingerprint, Paired, Servers};

fn messages<M: serde::de::DeserializeOwned>(mut bytes: &[u8]) -> Vec<M> {
    let (mut deframer, mut found) = (Deframer::default(), Vec::new());
    while !bytes.is_empty() {
        bytes = &bytes[deframer.push(bytes)..];
        while let Some(message) = deframer.next::<M>() {
            match message {
                Ok(message) => found.push(message),
                Err(FramingError::TooLong(_)) => return found,
                Err(FramingError::Body(_)) => {}
            }
        }
    }
    found
}

fuzz_target!(|bytes: &[u8]| {
    let print = Fingerprint::of(b"x");
    let binding = Binding { client: print, server: print, exporter: [0; 32] };
    let code: Code = "123456".parse().unwrap();
    let now = Instant::now();
    let mut server = PairingServer::default();
    server.open(now, code, Grant::Instructor);
    let mut attempt = None;
    for message in messages::<PairingRequest>(bytes) {
        match attempt.take() {
            // The code is known here, but a proof is a hash over our new random share.
            Some(begun) => assert!(server.confirm(now, begun, &message).is_err()),
            None => attempt = server.begin(now, &message, &binding).ok().map(|(begun, _)| begun),
        }
    }
    let mut confirming = None;
    for message in messages::<PairingReply>(bytes) {
        match message {
            PairingReply::Share { share } => {
                let (client, _) = PairingClient::begin(code, "x", binding);
                confirming = client.confirm(&share).map(|(confirming, _)| confirming);
            }
            PairingReply::Paired { proof, .. } => {
                if let Some(confirming) = confirming.take() {
                    assert!(!confirming.is_proof(&proof));
                }
            }
            PairingReply::Refused(_) => {}
        }
    }
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = Paired::parse(text);
        let _ = Servers::parse(text);
        let _ = text.parse::<Code>();
        let _ = text.parse::<Fingerprint>();
    }
});
