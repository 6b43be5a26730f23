//! Answers multicast DNS queries for `NAME.local` (RFC 6762), so that a bridge is found by name. Sans-IO: a query in,
//! an answer out.

use core::net::Ipv4Addr;

/// Multicast address and port of queries and answers.
pub const GROUP: (Ipv4Addr, u16) = (Ipv4Addr::new(224, 0, 0, 251), 5353);
/// Maximum length of an answer: header, a name of 32 letters with `local`, the record [bytes].
pub const ANSWER: usize = HEAD + 33 + 7 + 10 + 4;
/// Time to live of the answer, as RFC 6762, section 10, recommends for addresses [s].
const KEEP_S: u32 = 120;

/// Answers a query for the address of `name`.local. Returns the length of the answer.
pub fn answer(
    query: &[u8],
    name: &str,
    address: Ipv4Addr,
    out: &mut [u8; ANSWER],
) -> Option<usize> {
    let head = query.get(..HEAD)?;
    // Not a standard query.
    if head[2] & 0xF8 != 0 || name.is_empty() || name.len() > 32 {
        return None;
    }
    let mut asked = false;
    let mut at = HEAD;
    for _ in 0..u16::from_be_bytes([head[4], head[5]]) {
        let (is_ours, after) = compare(query, at, name)?;
        let &[kind_high, kind, class_high, class] = query.get(after..after + 4)? else {
            return None;
        };
        // The top bit of the class requests a unicast reply; a multicast reply is also valid.
        let for_address = kind_high == 0 && matches!(kind, KIND_A | KIND_ANY);
        asked |= is_ours && for_address && [class_high & 0x7F, class] == [0, CLASS_IN];
        at = after + 4;
    }
    if !asked {
        return None;
    }
    let mut len = 0;
    let mut put = |bytes: &[u8]| {
        out[len..len + bytes.len()].copy_from_slice(bytes);
        len += bytes.len();
    };
    // Authoritative answer with one record.
    put(&[0, 0, 0x84, 0, 0, 0, 0, 1, 0, 0, 0, 0]);
    put(&[name.len() as u8]);
    put(name.as_bytes());
    put(b"\x05local\0");
    // The top bit is the cache-flush flag: receivers drop other cached addresses.
    put(&[0, KIND_A, 0x80, CLASS_IN]);
    put(&KEEP_S.to_be_bytes());
    put(&[0, 4]);
    put(&address.octets());
    Some(len)
}

/// Returns whether the name at `at` is `name`.local, and the position after it.
fn compare(query: &[u8], mut at: usize, name: &str) -> Option<(bool, usize)> {
    let wanted: [&[u8]; 2] = [name.as_bytes(), b"local"];
    let (mut is_ours, mut labels) = (true, 0);
    // Position after the name's first pointer.
    let mut after = None;
    // A name of 255 bytes has at most 127 labels; this also ends loops of pointers.
    for _ in 0..128 {
        let len = usize::from(*query.get(at)?);
        match len {
            0 => return Some((is_ours && labels == wanted.len(), after.unwrap_or(at + 1))),
            1..=63 => {
                let label = query.get(at + 1..at + 1 + len)?;
                is_ours &= wanted.get(labels).is_some_and(|want| label.eq_ignore_ascii_case(want));
                labels += 1;
                at += 1 + len;
            }
            0xC0.. => {
                let low = usize::from(*query.get(at + 1)?);
                after = after.or(Some(at + 2));
                at = (len & 0x3F) << 8 | low;
            }
            _ => return None,
        }
    }
    None
}

// RFC 1035, section 4.
const HEAD: usize = 12;
const KIND_A: u8 = 1;
const KIND_ANY: u8 = 255;
const CLASS_IN: u8 = 1;

#[cfg(test)]
mod tests {
    extern crate std;
    use proptest::prelude::*;
    use std::vec::Vec;

    use super::*;

    const US: Ipv4Addr = Ipv4Addr::new(192, 168, 10, 7);

    fn query(questions: u8, body: &[u8]) -> Vec<u8> {
        let mut bytes = std::vec![0, 9, 0, 0, 0, questions, 0, 0, 0, 0, 0, 0];
        bytes.extend_from_slice(body);
        bytes
    }

    fn check(questions: u8, body: &[u8], answered: bool) {
        let mut out = [0; ANSWER];
        let len = answer(&query(questions, body), "drone-3", US, &mut out);
        assert_eq!(len.is_some(), answered, "{body:?}");
        if let Some(len) = len {
            let expected = b"\0\0\x84\0\0\0\0\x01\0\0\0\0\x07drone-3\x05local\0\0\x01\x80\x01\0\0\0\x78\0\x04\xC0\xA8\x0A\x07";
            assert_eq!(out[..len], expected[..]);
        }
    }

    #[test]
    fn answers_only_queries_for_its_own_name() {
        check(1, b"\x07drone-3\x05local\0\0\x01\0\x01", true);
        check(1, b"\x07DRONE-3\x05Local\0\0\xFF\x80\x01", true);
        check(1, b"\x07drone-4\x05local\0\0\x01\0\x01", false);
        check(1, b"\x07drone-3\x03lan\0\0\x01\0\x01", false);
        check(1, b"\x01x\x07drone-3\x05local\0\0\x01\0\x01", false);
        check(1, b"\x07drone-3\0\0\x01\0\x01", false);
        check(1, b"\x07drone-3\x05local\0\0\x1C\0\x01", false); // IPv6: not supported
        check(0, b"\x07drone-3\x05local\0\0\x01\0\x01", false);
        // The name of the second question ends with a pointer into the first.
        let two = b"\x04host\x05local\0\0\x01\0\x01\x07drone-3\xC0\x11\0\x01\0\x01";
        check(2, two, true);
        check(2, &two[..two.len() - 1], false);
        // A pointer to itself.
        check(1, b"\xC0\x0C\0\x01\0\x01", false);
    }

    #[test]
    fn ignores_answers_of_other_hosts() {
        let mut bytes = query(1, b"\x07drone-3\x05local\0\0\x01\0\x01");
        bytes[2] = 0x84;
        assert_eq!(answer(&bytes, "drone-3", US, &mut [0; ANSWER]), None);
    }

    proptest! {
        #[test]
        fn accepts_any_bytes(mut bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            if bytes.len() > 5 {
                (bytes[2], bytes[4]) = (0, 0);
            }
            let _ = answer(&bytes, "drone-3", US, &mut [0; ANSWER]);
        }

        #[test]
        fn the_longest_name_fits(name in "[a-z]{32}") {
            let mut body = std::vec![32];
            body.extend_from_slice(name.as_bytes());
            body.extend_from_slice(b"\x05local\0\0\x01\0\x01");
            prop_assert_eq!(answer(&query(1, &body), &name, US, &mut [0; ANSWER]), Some(ANSWER));
        }
    }
}
