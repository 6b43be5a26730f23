//! DHCP server of the bridge's own network: the part of RFC 2131 that one small network needs. Sans-IO: a request in,
//! an answer out.
//!
//! The bridge offers no router and no name server, so that a laptop keeps its own internet connection.

use core::net::Ipv4Addr;

/// Maximum number of leases. No chip's radio accepts more stations.
pub const LEASES: usize = 10;
/// Last byte of the first leased address; the bridge itself is 1.
const FIRST: u8 = 2;
/// Duration of a lease [s].
const LEASE_S: u32 = 24 * 3600;
/// Maximum length of an answer: fixed fields, cookie, options, end [bytes].
pub const ANSWER: usize = OPTIONS + 4 + 22;

/// Leases by address: entry `i` is address `FIRST + i`.
#[derive(Clone, Debug)]
pub struct Leases {
    taken: [Option<Lease>; LEASES],
    /// Number of requests so far. A lease with a smaller number was used longer ago.
    turn: u32,
}

#[derive(Clone, Copy, Debug)]
struct Lease {
    mac: [u8; 6],
    renewed: u32,
}

impl Default for Leases {
    fn default() -> Self {
        Self::new()
    }
}

impl Leases {
    /// Returns an empty table.
    pub const fn new() -> Self {
        Self { taken: [None; LEASES], turn: 0 }
    }

    /// Answers a datagram to port 67 for a bridge at `address`. Returns the length of the answer, which is to be
    /// broadcast to port 68. Returns `None` if the datagram is not a request or is for another server.
    pub fn answer(
        &mut self,
        address: Ipv4Addr,
        request: &[u8],
        out: &mut [u8; ANSWER],
    ) -> Option<usize> {
        let request = Request::read(request)?;
        if request.server.is_some_and(|server| server != address) {
            return None;
        }
        let offered = with_last(address, FIRST + self.place(request.mac) as u8);
        let (kind, given) = match request.kind {
            DISCOVER => (OFFER, offered),
            // A station that comes from another network requests its old address.
            REQUEST if request.wanted.is_some_and(|wanted| wanted != offered) => {
                (NAK, Ipv4Addr::UNSPECIFIED)
            }
            REQUEST => (ACK, offered),
            _ => return None,
        };
        out.fill(0);
        out[..4].copy_from_slice(&[BOOT_REPLY, ETHERNET, 6, 0]);
        out[4..8].copy_from_slice(&request.id);
        // Answers are broadcast, because the station has no address yet.
        out[10..12].copy_from_slice(&BROADCAST.to_be_bytes());
        out[16..20].copy_from_slice(&given.octets());
        out[20..24].copy_from_slice(&address.octets());
        out[28..34].copy_from_slice(&request.mac);
        out[OPTIONS..OPTIONS + 4].copy_from_slice(&COOKIE);
        let mut at = OPTIONS + 4;
        let mut put = |code: u8, value: &[u8]| {
            out[at] = code;
            out[at + 1] = value.len() as u8;
            out[at + 2..at + 2 + value.len()].copy_from_slice(value);
            at += 2 + value.len();
        };
        put(KIND, &[kind]);
        put(SERVER, &address.octets());
        if kind != NAK {
            put(LEASE_TIME, &LEASE_S.to_be_bytes());
            put(MASK, &[255, 255, 255, 0]);
        }
        out[at] = END;
        Some(at + 1)
    }

    /// Returns the entry of a station: its existing one, else a free one, else the least recently used.
    fn place(&mut self, mac: [u8; 6]) -> usize {
        self.turn = self.turn.wrapping_add(1);
        let own = self.taken.iter().position(|lease| lease.is_some_and(|lease| lease.mac == mac));
        let turn = self.turn;
        let age = |lease: &Option<Lease>| lease.map_or(u32::MAX, |l| turn.wrapping_sub(l.renewed));
        let place = own
            .or_else(|| (0..LEASES).rev().max_by_key(|&place| age(&self.taken[place])))
            .unwrap_or(0);
        self.taken[place] = Some(Lease { mac, renewed: turn });
        place
    }
}

/// Fields of a request that the server uses.
struct Request {
    id: [u8; 4],
    mac: [u8; 6],
    kind: u8,
    /// Requested address.
    wanted: Option<Ipv4Addr>,
    /// Server that the request is addressed to.
    server: Option<Ipv4Addr>,
}

impl Request {
    fn read(bytes: &[u8]) -> Option<Self> {
        let (head, options) = bytes.split_at_checked(OPTIONS)?;
        let mut options = options.strip_prefix(&COOKIE)?;
        if head[..3] != [BOOT_REQUEST, ETHERNET, 6] {
            return None;
        }
        let mut request = Self {
            id: array(&head[4..8])?,
            mac: array(&head[28..34])?,
            kind: 0,
            wanted: address(&head[12..16]),
            server: None,
        };
        while let &[code, ref rest @ ..] = options {
            match code {
                PAD => {
                    options = rest;
                    continue;
                }
                END => break,
                _ => {}
            }
            let (&len, rest) = rest.split_first()?;
            let (value, rest) = rest.split_at_checked(usize::from(len))?;
            match code {
                KIND => request.kind = *value.first()?,
                WANTED => request.wanted = address(value),
                SERVER => request.server = address(value),
                _ => {}
            }
            options = rest;
        }
        Some(request)
    }
}

fn array<const N: usize>(bytes: &[u8]) -> Option<[u8; N]> {
    bytes.try_into().ok()
}

/// Returns an address; `None` for 0.0.0.0.
fn address(bytes: &[u8]) -> Option<Ipv4Addr> {
    array::<4>(bytes).map(Ipv4Addr::from).filter(|address| !address.is_unspecified())
}

fn with_last(address: Ipv4Addr, last: u8) -> Ipv4Addr {
    let [a, b, c, _] = address.octets();
    Ipv4Addr::new(a, b, c, last)
}

// RFC 2131, section 2, and RFC 2132.
const OPTIONS: usize = 236;
const COOKIE: [u8; 4] = [99, 130, 83, 99];
const BOOT_REQUEST: u8 = 1;
const BOOT_REPLY: u8 = 2;
const ETHERNET: u8 = 1;
const BROADCAST: u16 = 0x8000;
const PAD: u8 = 0;
const MASK: u8 = 1;
const WANTED: u8 = 50;
const LEASE_TIME: u8 = 51;
const KIND: u8 = 53;
const SERVER: u8 = 54;
const END: u8 = 255;
const DISCOVER: u8 = 1;
const OFFER: u8 = 2;
const REQUEST: u8 = 3;
const ACK: u8 = 5;
const NAK: u8 = 6;

#[cfg(test)]
mod tests {
    extern crate std;
    use proptest::prelude::*;
    use std::vec::Vec;

    use super::*;

    const US: Ipv4Addr = Ipv4Addr::new(192, 168, 4, 1);

    fn request(mac: u8, kind: u8, options: &[u8]) -> Vec<u8> {
        let mut bytes = std::vec![0; OPTIONS];
        bytes[..3].copy_from_slice(&[1, 1, 6]);
        bytes[4..8].copy_from_slice(&[1, 2, 3, mac]);
        bytes[28..34].copy_from_slice(&[2, 0, 0, 0, 0, mac]);
        bytes.extend_from_slice(&COOKIE);
        bytes.extend_from_slice(&[PAD, KIND, 1, kind]);
        bytes.extend_from_slice(options);
        bytes.push(END);
        bytes
    }

    /// Returns (kind, address) of the answer.
    fn ask(leases: &mut Leases, request: &[u8]) -> Option<(u8, Ipv4Addr)> {
        let mut out = [0xAA; ANSWER];
        let len = leases.answer(US, request, &mut out)?;
        assert_eq!(out[0], BOOT_REPLY);
        assert_eq!(out[4..8], request[4..8], "transaction id differs");
        assert_eq!(out[28..34], request[28..34]);
        assert_eq!(out[OPTIONS..OPTIONS + 4], COOKIE);
        assert_eq!(out[len - 1], END);
        assert_eq!(out[OPTIONS + 7..OPTIONS + 13], [SERVER, 4, 192, 168, 4, 1]);
        Some((out[OPTIONS + 6], Ipv4Addr::new(out[16], out[17], out[18], out[19])))
    }

    #[test]
    fn a_station_keeps_its_address() {
        let mut leases = Leases::new();
        let first = Ipv4Addr::new(192, 168, 4, 2);
        let second = Ipv4Addr::new(192, 168, 4, 3);
        assert_eq!(ask(&mut leases, &request(7, DISCOVER, &[])), Some((OFFER, first)));
        assert_eq!(ask(&mut leases, &request(8, DISCOVER, &[])), Some((OFFER, second)));
        let take = [WANTED, 4, 192, 168, 4, 2, SERVER, 4, 192, 168, 4, 1];
        assert_eq!(ask(&mut leases, &request(7, REQUEST, &take)), Some((ACK, first)));
        // Later requests: for an address of another network, then for the leased one.
        let other = [WANTED, 4, 10, 0, 0, 5];
        let none = Ipv4Addr::UNSPECIFIED;
        assert_eq!(ask(&mut leases, &request(7, REQUEST, &other)), Some((NAK, none)));
        assert_eq!(ask(&mut leases, &request(7, REQUEST, &take)), Some((ACK, first)));
        assert_eq!(ask(&mut leases, &request(8, REQUEST, &[])), Some((ACK, second)));
    }

    #[test]
    fn requests_to_other_servers_and_other_packets_are_ignored() {
        let mut leases = Leases::new();
        let other = [SERVER, 4, 192, 168, 4, 9];
        assert_eq!(ask(&mut leases, &request(7, REQUEST, &other)), None);
        assert_eq!(ask(&mut leases, &request(7, 7, &[])), None, "a release");
        let good = request(7, DISCOVER, &[]);
        for len in 0..OPTIONS + 4 {
            assert_eq!(ask(&mut leases, &good[..len]), None);
        }
        let mut reply = good;
        reply[0] = BOOT_REPLY;
        assert_eq!(ask(&mut leases, &reply), None);
    }

    #[test]
    fn replaces_the_least_recently_used_lease() {
        let mut leases = Leases::new();
        for mac in 0..LEASES as u8 {
            let expected = Ipv4Addr::new(192, 168, 4, FIRST + mac);
            assert_eq!(ask(&mut leases, &request(mac, DISCOVER, &[])), Some((OFFER, expected)));
        }
        ask(&mut leases, &request(0, REQUEST, &[]));
        let of_one = Ipv4Addr::new(192, 168, 4, FIRST + 1);
        assert_eq!(ask(&mut leases, &request(99, DISCOVER, &[])), Some((OFFER, of_one)));
    }

    proptest! {
        #[test]
        fn accepts_any_bytes(
            mut bytes in proptest::collection::vec(any::<u8>(), 0..600),
            valid_head in any::<bool>(),
        ) {
            if valid_head && bytes.len() >= OPTIONS + 4 {
                bytes[..3].copy_from_slice(&[1, 1, 6]);
                bytes[OPTIONS..OPTIONS + 4].copy_from_slice(&COOKIE);
            }
            let mut out = [0; ANSWER];
            if let Some(len) = Leases::new().answer(US, &bytes, &mut out) {
                prop_assert!(len <= ANSWER);
            }
        }
    }
}
