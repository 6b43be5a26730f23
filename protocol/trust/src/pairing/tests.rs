//! Pairing in memory: between two honest sides, and with attackers.

use std::time::Instant;

use proptest::prelude::*;
use vizflyt_protocol::messages::{Grant, PairingProof, PairingRequest, PairingShare, bounded};

use super::*;
use crate::Role;

fn code(text: &str) -> Code {
    text.parse().unwrap()
}

fn team() -> Grant {
    Grant::Team { vehicles: heapless_one("ant") }
}

/// Returns a list with one name, in the message's list type.
fn heapless_one<const N: usize>(name: &str) -> heapless::Vec<vizflyt_protocol::messages::Name, N> {
    std::iter::once(bounded(name)).collect()
}

fn binding(connection: u8) -> Binding {
    Binding {
        client: Fingerprint::of(b"client"),
        server: Fingerprint::of(b"server"),
        exporter: [connection; 32],
    }
}

struct Lab {
    server: PairingServer,
    now: Instant,
}

/// Result of a client's attempt.
#[derive(Debug, PartialEq)]
enum PairingOutcome {
    Paired(Box<Admitted>),
    Refused(Refusal),
    /// The server's proof was invalid.
    Deceived,
}

impl Lab {
    fn open(text: &str) -> Self {
        let mut lab = Self { server: PairingServer::default(), now: Instant::now() };
        assert!(lab.server.open(lab.now, code(text), team()));
        lab
    }

    fn begin(
        &mut self,
        message: &PairingRequest,
        seen: &Binding,
    ) -> Result<(Attempt, PairingShare), Refusal> {
        self.server.begin(self.now, message, seen)
    }

    /// Runs a client with `text` on a connection. The two ends may see it differently.
    fn pair(&mut self, text: &str, client_sees: Binding, server_sees: Binding) -> PairingOutcome {
        let (client, message) = PairingClient::begin(code(text), "jetson", client_sees);
        let (attempt, share) = match self.begin(&message, &server_sees) {
            Ok(begun) => begun,
            Err(refusal) => return PairingOutcome::Refused(refusal),
        };
        let (confirming, message) = client.confirm(&share).unwrap();
        match self.server.confirm(self.now, attempt, &message) {
            Ok(admitted) if confirming.is_proof(&admitted.proof) => {
                PairingOutcome::Paired(Box::new(admitted))
            }
            Ok(_) => PairingOutcome::Deceived,
            Err(refusal) => PairingOutcome::Refused(refusal),
        }
    }

    fn try_code(&mut self, text: &str) -> PairingOutcome {
        self.pair(text, binding(1), binding(1))
    }

    fn is_open(&mut self) -> bool {
        self.server.state(self.now).is_some()
    }
}

#[test]
fn the_right_code_pairs_once() {
    let mut lab = Lab::open("123456");
    let state = lab.server.state(lab.now).unwrap();
    assert_eq!((state.left, state.tries_left, state.grant), (VALID, TRIES, team()));
    assert!(!lab.server.open(lab.now, code("000000"), Grant::Instructor), "one window at a time");
    let PairingOutcome::Paired(admitted) = lab.try_code("123 456") else { panic!() };
    assert_eq!(admitted.client.fingerprint, Fingerprint::of(b"client"));
    assert_eq!((admitted.client.name.as_str(), admitted.client.role), ("jetson", Role::Team));
    assert_eq!((admitted.client.vehicles, admitted.grant), (vec!["ant".to_owned()], team()));
    assert!(!lab.is_open());
    assert_eq!(lab.try_code("123456"), PairingOutcome::Refused(Refusal::Closed));
}

#[test]
fn closes_the_window_after_three_wrong_codes() {
    let mut lab = Lab::open("123456");
    assert_eq!(lab.try_code("123457"), PairingOutcome::Refused(Refusal::Wrong { left: 2 }));
    assert_eq!(lab.try_code("654321"), PairingOutcome::Refused(Refusal::Wrong { left: 1 }));
    assert_eq!(lab.try_code("000000"), PairingOutcome::Refused(Refusal::Shut));
    assert_eq!(lab.try_code("123456"), PairingOutcome::Refused(Refusal::Closed));
    let mut lab = Lab::open("123456");
    lab.try_code("123457");
    assert!(
        matches!(lab.try_code("123456"), PairingOutcome::Paired(_)),
        "one typing error does not prevent pairing"
    );
}

#[test]
fn parallel_attempts_share_the_three_tries() {
    let mut lab = Lab::open("123456");
    let seen = binding(1);
    let mut begun: Vec<_> = (0..9)
        .map(|guess| {
            let (client, message) = PairingClient::begin(Code::from_number(guess), "jetson", seen);
            (client, lab.begin(&message, &seen).unwrap())
        })
        .collect();
    let ends: Vec<_> = begun
        .drain(..)
        .map(|(client, (attempt, share))| {
            let (_, message) = client.confirm(&share).unwrap();
            lab.server.confirm(lab.now, attempt, &message).unwrap_err()
        })
        .collect();
    assert_eq!(ends[..3], [Refusal::Wrong { left: 2 }, Refusal::Wrong { left: 1 }, Refusal::Shut]);
    assert!(ends[3..].iter().all(|end| *end == Refusal::Closed), "{ends:?}");
}

#[test]
fn a_code_expires_between_two_messages() {
    let mut lab = Lab::open("123456");
    let seen = binding(1);
    let (client, message) = PairingClient::begin(code("123456"), "jetson", seen);
    let (attempt, share) = lab.begin(&message, &seen).unwrap();
    let (_, message) = client.confirm(&share).unwrap();
    let opened = lab.now;
    lab.now += VALID.mul_f64(0.999);
    assert!(lab.is_open());
    lab.now = opened + VALID;
    assert!(!lab.is_open());
    // The attempt must not succeed in the next window, even with the same code.
    assert!(lab.server.open(lab.now, code("123456"), Grant::Instructor));
    let end = lab.server.confirm(lab.now, attempt, &message);
    assert_eq!(end, Err(Refusal::Closed));
}

/// A man in the middle has his own certificate on each side, so each connection has its own exporter. He forwards every
/// message unchanged.
#[test]
fn rejects_a_relay_even_with_the_right_code() {
    let middle = Fingerprint::of(b"middle");
    let toward_client = Binding { server: middle, ..binding(1) };
    let toward_server = Binding { client: middle, ..binding(2) };
    let mut lab = Lab::open("123456");
    let end = lab.pair("123456", toward_client, toward_server);
    assert_eq!(end, PairingOutcome::Refused(Refusal::Wrong { left: 2 }));
    // Each part of the binding is checked.
    for other in [
        Binding { exporter: [2; 32], ..binding(1) },
        Binding { client: middle, ..binding(1) },
        Binding { server: middle, ..binding(1) },
    ] {
        let mut lab = Lab::open("123456");
        let end = lab.pair("123456", binding(1), other);
        assert_eq!(end, PairingOutcome::Refused(Refusal::Wrong { left: 2 }), "{other:?}");
    }
}

/// An attacker poses as the server with a guessed code, and gets one proof to test the guess.
#[test]
fn rejects_a_false_server_with_a_wrong_guess() {
    let seen = Binding { server: Fingerprint::of(b"middle"), ..binding(1) };
    let (client, message) = PairingClient::begin(code("123456"), "jetson", seen);
    let mut false_server = Lab::open("111111");
    let (attempt, share) = false_server.begin(&message, &seen).unwrap();
    let (confirming, message) = client.confirm(&share).unwrap();
    let end = false_server.server.confirm(false_server.now, attempt, &message);
    assert_eq!(
        end,
        Err(Refusal::Wrong { left: 2 }),
        "the attacker gets only the result of one guess"
    );
    // The attacker replies anyway, with the client's proof or other data.
    let PairingRequest::Confirm { proof } = message else { panic!() };
    assert!(!confirming.is_proof(&proof), "the two proofs differ, so an echo is invalid");
}

#[test]
fn rejects_replayed_messages() {
    let seen = binding(1);
    let mut lab = Lab::open("123456");
    let (client, begin) = PairingClient::begin(code("123456"), "jetson", seen);
    let (attempt, share) = lab.begin(&begin, &seen).unwrap();
    let (confirming, confirm) = client.confirm(&share).unwrap();
    let admitted = lab.server.confirm(lab.now, attempt, &confirm).unwrap();
    assert!(confirming.is_proof(&admitted.proof));
    // The same code, the same fingerprints, even the same exporter: the server's share is new in each attempt.
    let mut lab = Lab::open("123456");
    let (attempt, _) = lab.begin(&begin, &seen).unwrap();
    let end = lab.server.confirm(lab.now, attempt, &confirm);
    assert_eq!(end, Err(Refusal::Wrong { left: 2 }));
    // The server's old proof is invalid for a new client.
    let (client, _) = PairingClient::begin(code("123456"), "jetson", seen);
    let (confirming, _) = client.confirm(&share).unwrap();
    assert!(!confirming.is_proof(&admitted.proof));
}

#[test]
fn rejects_messages_out_of_order() {
    let mut lab = Lab::open("123456");
    let seen = binding(1);
    let confirm = PairingRequest::Confirm { proof: [0; 32] };
    assert_eq!(lab.begin(&confirm, &seen).err(), Some(Refusal::Foreign));
    let (_, begin) = PairingClient::begin(code("123456"), "jetson", seen);
    let (attempt, _) = lab.begin(&begin, &seen).unwrap();
    assert_eq!(lab.server.confirm(lab.now, attempt, &begin), Err(Refusal::Foreign));
    for name in ["", "a\nb", "\u{1b}[31m"] {
        let begin = PairingRequest::Begin { name: bounded(name), share: [7; 32] };
        assert_eq!(lab.begin(&begin, &seen).err(), Some(Refusal::Name), "{name:?}");
    }
    assert_eq!(lab.server.state(lab.now).unwrap().tries_left, TRIES, "nothing was tried");
}

proptest! {
    #[test]
    fn rejects_any_other_code_name_or_share(
        right in 0..CODES, wrong in 0..CODES, flip in 0..256_usize, other in "[a-z]{1,8}",
    ) {
        prop_assume!(right != wrong && other != "jetson");
        let (right, wrong) = (Code::from_number(right), Code::from_number(wrong));
        let seen = binding(1);
        // (the client's code, change of its first message, whether it pairs)
        let tampered = |message: PairingRequest, kind: u8| match (message, kind) {
            (PairingRequest::Begin { share, .. }, 1) => {
                PairingRequest::Begin { name: bounded(&other), share }
            }
            (PairingRequest::Begin { name, mut share }, 2) => {
                share[flip / 8] ^= 1 << (flip % 8);
                PairingRequest::Begin { name, share }
            }
            (message, _) => message,
        };
        for (text, kind, pairs) in [(right, 0, true), (wrong, 0, false), (right, 1, false), (right, 2, false)] {
            let mut lab = Lab::open(&right.to_string());
            let (client, message) = PairingClient::begin(text, "jetson", seen);
            let Ok((attempt, share)) = lab.begin(&tampered(message, kind), &seen) else {
                prop_assert!(kind == 2);
                continue;
            };
            let (_, message) = client.confirm(&share).unwrap();
            prop_assert_eq!(lab.server.confirm(lab.now, attempt, &message).is_ok(), pairs);
        }
    }

    #[test]
    fn rejects_arbitrary_messages_without_a_panic(share: PairingShare, proof: PairingProof) {
        let mut lab = Lab::open("123456");
        let seen = binding(1);
        let begin = PairingRequest::Begin { name: bounded("x"), share };
        if let Ok((attempt, _)) = lab.begin(&begin, &seen) {
            let end = lab.server.confirm(lab.now, attempt, &PairingRequest::Confirm { proof });
            prop_assert_eq!(end, Err(Refusal::Wrong { left: 2 }));
        }
        let (client, _) = PairingClient::begin(code("123456"), "x", seen);
        if let Some((confirming, _)) = client.confirm(&share) {
            prop_assert!(!confirming.is_proof(&proof));
        }
    }

    #[test]
    fn parses_printed_codes(number in 0..CODES) {
        let code = Code::from_number(number);
        prop_assert_eq!(code.to_string().parse(), Ok(code));
        prop_assert_eq!(format!("{number:06}").parse(), Ok(code));
    }
}

#[test]
fn rejects_invalid_codes() {
    for wrong in ["", "12345", "1234567", "12345a", "١٢٣٤٥٦"] {
        assert!(wrong.parse::<Code>().is_err(), "{wrong}");
    }
    assert_eq!(format!("{:?}", code("123456")), "Code(..)", "not for logs");
    let codes: std::collections::BTreeSet<_> =
        (0..50).map(|_| Code::random().unwrap().to_string()).collect();
    assert!(codes.len() > 40, "fifty random codes of a million repeat rarely");
}
