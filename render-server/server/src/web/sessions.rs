//! Sessions, and tokens against forged requests (CSRF); no I/O.
//!
//! A session is a random number in a cookie. The server stores only its hash, in memory: a restart ends all sessions. A
//! token proves that a page of this server made a request: pages of other sites can send the cookie, but cannot read
//! the token that belongs to it.

use std::collections::HashMap;
use std::time::{Duration, Instant};

use ring::hmac;
use ring::rand::SystemRandom;
use vizflyt_trust::{FileStamp, Fingerprint, secret};

/// Sessions of instructors who have logged in with the password.
#[derive(Debug, Default)]
pub(super) struct Sessions {
    live: HashMap<Fingerprint, Instant>,
    /// State of the password's file at their login.
    password: Option<FileStamp>,
}

impl Sessions {
    /// Begins a session and returns its cookie. Above the maximum, the session that was unused for longest ends.
    ///
    /// # Errors
    /// If the system's random number generator fails.
    pub(super) fn begin(
        &mut self,
        now: Instant,
        password: Option<FileStamp>,
    ) -> Result<String, String> {
        self.forget(now, password);
        if self.live.len() >= MAX_SESSIONS
            && let Some(oldest) = self.live.iter().min_by_key(|(_, ends)| **ends).map(|(id, _)| *id)
        {
            self.live.remove(&oldest);
        }
        let cookie = secret()?;
        self.live.insert(Fingerprint::of(cookie.as_bytes()), now + IDLE);
        Ok(cookie)
    }

    /// Whether a cookie belongs to a live session; if so, restarts its idle time. Ends all sessions if `password` has
    /// changed.
    pub(super) fn is_live(
        &mut self,
        now: Instant,
        password: Option<FileStamp>,
        cookie: &str,
    ) -> bool {
        if self.live.is_empty() {
            return false;
        }
        self.forget(now, password);
        let session = self.live.get_mut(&Fingerprint::of(cookie.as_bytes()));
        session.map(|ends| *ends = now + IDLE).is_some()
    }

    pub(super) fn end(&mut self, cookie: &str) {
        self.live.remove(&Fingerprint::of(cookie.as_bytes()));
    }

    fn forget(&mut self, now: Instant, password: Option<FileStamp>) {
        if self.password != password {
            self.live.clear();
            self.password = password;
        }
        self.live.retain(|_, ends| *ends > now);
    }
}

/// Derives tokens from their cookies, so that none need to be stored.
#[derive(Debug)]
pub(super) struct Tokens(hmac::Key);

impl Tokens {
    /// Creates the key of one run of the server.
    ///
    /// # Errors
    /// If the system's random number generator fails.
    pub(super) fn new() -> Result<Self, String> {
        hmac::Key::generate(hmac::HMAC_SHA256, &SystemRandom::new())
            .map(Self)
            .map_err(|_| "the system gives no random numbers".to_owned())
    }

    /// Returns the token of a cookie: 64 hexadecimal digits.
    pub(super) fn of(&self, cookie: &str) -> String {
        vizflyt_trust::hex(hmac::sign(&self.0, cookie.as_bytes()).as_ref())
    }

    /// Whether `token` belongs to the cookie, in constant time.
    pub(super) fn fits(&self, cookie: &str, token: &str) -> bool {
        let bytes: Option<Vec<u8>> = (0..token.len())
            .step_by(2)
            .map(|at| u8::from_str_radix(token.get(at..at + 2)?, 16).ok())
            .collect();
        bytes.is_some_and(|bytes| hmac::verify(&self.0, cookie.as_bytes(), &bytes).is_ok())
    }
}

/// Idle timeout of a session. An open page keeps its session alive.
const IDLE: Duration = Duration::from_hours(12);
/// Maximum number of sessions: several times an instructor's browsers.
const MAX_SESSIONS: usize = 64;

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn session_lasts_while_used_and_ends_at_logout() {
        let (mut sessions, start) = (Sessions::default(), Instant::now());
        let cookie = sessions.begin(start, None).unwrap();
        let mut now = start;
        for _ in 0..5 {
            now += IDLE.mul_f64(0.9);
            assert!(sessions.is_live(now, None, &cookie));
        }
        assert!(!sessions.is_live(now, None, "") && !sessions.is_live(now, None, &cookie[1..]));
        let other = sessions.begin(now, None).unwrap();
        sessions.end(&cookie);
        assert!(!sessions.is_live(now, None, &cookie) && sessions.is_live(now, None, &other));
        assert!(!sessions.is_live(now + IDLE, None, &other));
    }

    #[test]
    fn another_password_ends_all_sessions_and_their_number_is_bounded() {
        let root = tempfile::tempdir().unwrap();
        let folder = vizflyt_trust::KeysFolder::open(Some(&root.path().join("keys"))).unwrap();
        let stamp = |text: &str| {
            folder.write("x", text).unwrap();
            folder.stamp("x")
        };
        let (mut sessions, start) = (Sessions::default(), Instant::now());
        let first = stamp("one");
        let cookies: Vec<_> = (0..MAX_SESSIONS + 5)
            .map(|k| sessions.begin(start + Duration::from_secs(k as u64), first).unwrap())
            .collect();
        let now = start + Duration::from_secs(1000);
        let live = cookies.iter().filter(|cookie| sessions.is_live(now, first, cookie)).count();
        assert_eq!(live, MAX_SESSIONS);
        assert!(!sessions.is_live(now, first, &cookies[0]), "the oldest went first");
        let second = stamp("another");
        assert!(!sessions.is_live(now, second, &cookies[60]));
        assert!(sessions.live.is_empty());
    }

    #[test]
    fn a_token_fits_only_its_own_cookie() {
        let (tokens, others) = (Tokens::new().unwrap(), Tokens::new().unwrap());
        let token = tokens.of("cookie");
        assert_eq!(token.len(), 64);
        assert!(tokens.fits("cookie", &token));
        for (cookie, token) in [
            ("cookies", token.as_str()),
            ("cookie", ""),
            ("cookie", &token[..62]),
            ("cookie", &token[1..]),
            ("cookie", "zz"),
            ("cookie", "ä"),
        ] {
            assert!(!tokens.fits(cookie, token), "{cookie} {token}");
        }
        assert!(!others.fits("cookie", &token), "of another run");
    }
}
