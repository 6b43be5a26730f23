//! Rate limit for unknown peers: failed attempts (connections, logins) are counted by address. Pure.
//!
//! Only validated addresses are charged (after a complete handshake), so that an attacker cannot use up the
//! attempts of another address. Memory is bounded: addresses without debt are removed, and when all entries are
//! taken, all further addresses share one.

use std::collections::HashMap;
use std::net::{IpAddr, Ipv6Addr};
use std::time::{Duration, Instant};

/// Failed attempts by address.
#[derive(Debug, Default)]
pub(crate) struct RateLimiter {
    debts: HashMap<IpAddr, Debt>,
    /// Debt of all addresses without their own entry.
    others: Option<Debt>,
}

/// Token bucket, stored as the time at which it is full again.
#[derive(Clone, Copy, Debug)]
struct Debt {
    full_at: Instant,
}

impl RateLimiter {
    /// Returns whether an address has attempts left.
    pub(crate) fn may_try(&self, now: Instant, address: IpAddr) -> bool {
        let debt = self.debts.get(&place(address)).or(self.others.as_ref());
        debt.is_none_or(|debt| debt.owed(now) + EACH <= EACH * BURST)
    }

    /// Charges one attempt.
    pub(crate) fn charge(&mut self, now: Instant, address: IpAddr) {
        let place = place(address);
        if self.debts.len() >= MAX_PLACES && !self.debts.contains_key(&place) {
            self.debts.retain(|_, debt| debt.owed(now) > Duration::ZERO);
        }
        let full = self.debts.len() >= MAX_PLACES;
        let debt = match self.debts.get_mut(&place) {
            Some(debt) => debt,
            None if full => self.others.get_or_insert(Debt { full_at: now }),
            None => self.debts.entry(place).or_insert(Debt { full_at: now }),
        };
        debt.full_at = debt.full_at.max(now) + EACH;
    }
}

impl Debt {
    fn owed(self, now: Instant) -> Duration {
        self.full_at.saturating_duration_since(now)
    }
}

/// Returns the unit of the limit: of IPv6 a /64, because each user has a whole one (RFC 6177).
pub(crate) fn place(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => Ipv6Addr::from_bits(v6.to_bits() >> 64 << 64).into(),
        v4 @ IpAddr::V4(_) => v4,
    }
}

/// Attempts at once: more than the typing errors of a user.
const BURST: u32 = 10;
/// Time until one attempt is available again.
const EACH: Duration = Duration::from_secs(3);
/// Maximum number of entries: about 100 KB.
const MAX_PLACES: usize = 1024;

#[cfg(test)]
mod tests {
    use super::*;
    use std::net::Ipv4Addr;

    fn ip(text: &str) -> IpAddr {
        text.parse().unwrap()
    }

    /// Returns the number of attempts left to `address` at `now`, and charges them.
    fn attempts(limiter: &mut RateLimiter, now: Instant, address: IpAddr) -> u32 {
        let mut count = 0;
        while limiter.may_try(now, address) {
            limiter.charge(now, address);
            count += 1;
        }
        count
    }

    #[test]
    fn allows_a_burst_then_one_attempt_at_a_time() {
        let (mut limiter, start) = (RateLimiter::default(), Instant::now());
        let stranger = ip("192.168.1.9");
        assert_eq!(attempts(&mut limiter, start, stranger), BURST);
        assert_eq!(attempts(&mut limiter, start, ip("::ffff:192.168.1.9")), 0, "the same address");
        assert_eq!(attempts(&mut limiter, start, ip("192.168.1.10")), BURST, "another one");
        assert_eq!(attempts(&mut limiter, start + EACH, stranger), 1);
        assert_eq!(attempts(&mut limiter, start + EACH * 1000, stranger), BURST, "and no more");
    }

    #[test]
    fn an_ipv6_network_counts_as_one_address() {
        let (mut limiter, now) = (RateLimiter::default(), Instant::now());
        assert_eq!(attempts(&mut limiter, now, ip("2001:db8::1")), BURST);
        assert_eq!(attempts(&mut limiter, now, ip("2001:db8::2:1")), 0);
        assert_eq!(attempts(&mut limiter, now, ip("2001:db8:0:1::1")), BURST);
    }

    #[test]
    fn memory_is_bounded_for_many_addresses() {
        let (mut limiter, start) = (RateLimiter::default(), Instant::now());
        for bits in 0..20_000 {
            limiter.charge(start, Ipv4Addr::from_bits(bits).into());
        }
        assert_eq!(limiter.debts.len(), MAX_PLACES);
        let late = Ipv4Addr::from_bits(30_000).into();
        assert!(!limiter.may_try(start, late), "the rest shares what is left, and that is used up");
        // Addresses that were charged once are free again, and make room.
        let later = start + EACH * 20_000;
        assert_eq!(attempts(&mut limiter, later, late), BURST);
        assert_eq!(limiter.debts.len(), 1);
    }
}
