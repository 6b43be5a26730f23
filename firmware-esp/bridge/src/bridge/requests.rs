//! Handles the configuration requests of [`access`](crate::access).

use vizflyt_protocol::time::HostTime;

use super::router::PacketRouter;
use crate::access::{HEAD, Op, PROOF, ShellRequest, Status};
use crate::page::form::Form;
use crate::settings::{Refused, key_to_hex};

impl PacketRouter {
    /// Answers a request. Returns the length of the answer.
    pub(super) fn handle_request(
        &mut self,
        now: HostTime,
        request: &[u8],
        answer: &mut [u8],
    ) -> usize {
        let number = request.first().copied().unwrap_or(0);
        let mut body = 2;
        let status = match (Op::from_number(number), request.get(HEAD..)) {
            (Some(op), Some(rest)) => {
                let (status, len) = self.answer(now, op, request, rest, &mut answer[2..]);
                body += len;
                status
            }
            _ => Status::Unknown,
        };
        answer[0] = number | 0x80;
        answer[1] = status as u8;
        body
    }

    fn answer(
        &mut self,
        now: HostTime,
        op: Op,
        request: &[u8],
        rest: &[u8],
        out: &mut [u8],
    ) -> (Status, usize) {
        let mut rest = rest;
        if op.changes() || op == Op::Claim {
            if let Some(status) = self.refusal(op, request) {
                self.stats.refused = self.stats.refused.wrapping_add(1);
                return (status, 0);
            }
            if op.changes() {
                rest = &rest[..rest.len() - PROOF];
            }
        }
        let text = core::str::from_utf8(rest).unwrap_or_default();
        match op {
            Op::Hello => (Status::Done, self.hello(out)),
            Op::Stats => (Status::Done, self.report(now, out)),
            Op::Read => match self.settings.read(text) {
                Some(value) => {
                    out[..value.len()].copy_from_slice(value.as_bytes());
                    (Status::Done, value.len())
                }
                None => (Status::Unknown, 0),
            },
            Op::Set => {
                let status = match text.split_once('=') {
                    Some((name, value)) => status_of(self.settings.set(name, value)),
                    None => Status::Malformed,
                };
                self.apply_settings(now);
                (status, 0)
            }
            Op::Save => {
                self.grant(now, ShellRequest::Save);
                (Status::Done, 0)
            }
            Op::Reset => {
                self.grant(now, ShellRequest::Reset);
                (Status::Done, 0)
            }
            Op::Restart => {
                self.grant(now, ShellRequest::Restart);
                (Status::Done, 0)
            }
            Op::Claim => match rest.try_into() {
                Ok(key) => {
                    self.settings.key = Some(key);
                    self.grant(now, ShellRequest::Save);
                    (Status::Done, 0)
                }
                Err(_) => (Status::Malformed, 0),
            },
        }
    }

    /// Returns why a change is refused; `None` if it is allowed.
    fn refusal(&mut self, op: Op, request: &[u8]) -> Option<Status> {
        if self.flight.armed {
            return Some(Status::Armed);
        }
        match (self.settings.key, op) {
            (None, Op::Claim) => None,
            (None, _) => Some(Status::Unclaimed),
            (Some(_), Op::Claim) => Some(Status::Claimed),
            (Some(key), _) => {
                (!self.outstanding.access.proves(&key, request)).then_some(Status::WrongKey)
            }
        }
    }

    /// Changes a setting as requested by a browser's form.
    pub(super) fn change_by_form(&mut self, now: HostTime, form: &Form) -> Status {
        let refusal =
            if self.flight.armed { Some(Status::Armed) } else { self.form_refusal(now, &form.key) };
        if let Some(status) = refusal {
            self.stats.refused = self.stats.refused.wrapping_add(1);
            return status;
        }
        let status = status_of(self.settings.set(&form.name, &form.value));
        if status == Status::Done {
            self.apply_settings(now);
            self.grant(now, ShellRequest::Save);
            if form.restart {
                self.grant(now, ShellRequest::Restart);
            }
        }
        status
    }

    /// Returns why a typed key is refused; `None` if it is accepted.
    fn form_refusal(&mut self, now: HostTime, typed: &str) -> Option<Status> {
        let own = self.settings.key.as_ref().map(key_to_hex);
        let right = [Some(&self.settings.page_key), own.as_ref()]
            .into_iter()
            .flatten()
            .filter(|key| !key.is_empty())
            .any(|key| is_same(key, typed));
        if now < self.form_opens_at {
            return Some(Status::WrongKey);
        }
        if !right {
            self.form_opens_at = now.plus_seconds(GUESS_S);
            return Some(Status::WrongKey);
        }
        None
    }

    fn hello(&self, out: &mut [u8]) -> usize {
        let access = &self.outstanding.access;
        out[..16].copy_from_slice(&access.nonce);
        out[16..20].copy_from_slice(&access.counter.to_le_bytes());
        out[20] = u8::from(self.settings.key.is_some())
            | u8::from(self.flight.armed) << 1
            | u8::from(self.transparent) << 2;
        let version = env!("CARGO_PKG_VERSION").as_bytes();
        out[21..21 + version.len()].copy_from_slice(version);
        21 + version.len()
    }

    fn report(&self, now: HostTime, out: &mut [u8]) -> usize {
        let counters = self.stats.report(now.seconds_since(self.started_at) as u32);
        for (bytes, counter) in out.chunks_exact_mut(4).zip(counters) {
            bytes.copy_from_slice(&counter.to_le_bytes());
        }
        4 * counters.len()
    }
}

/// After a wrong key, the form rejects every key for this long [s]. This prevents guessing of 80-bit keys and of short
/// passwords.
const GUESS_S: f64 = 2.0;

/// Compares two keys in constant time.
fn is_same(key: &str, typed: &str) -> bool {
    let differ = key.bytes().zip(typed.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b));
    key.len() == typed.len() && differ == 0
}

fn status_of(result: Result<(), Refused>) -> Status {
    match result {
        Ok(()) => Status::Done,
        Err(Refused::Unknown) => Status::Unknown,
        Err(Refused::Malformed) => Status::Malformed,
        Err(Refused::OutOfRange) => Status::OutOfRange,
    }
}
