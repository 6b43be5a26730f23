//! Ring buffer of packets: first in, first out, several readers. If it is full, the writer decides which packets to
//! drop, so that it can count them.

use vizflyt_protocol::mavlink::MAX_PACKET;

/// Metadata of a packet in the ring.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Tag {
    /// Message number; 65535 if it does not fit.
    pub kind: u16,
    /// Sender (system, component).
    pub source: (u8, u8),
    /// Receiving clients, one bit each.
    pub to: u8,
    /// Whether the bridge itself made the packet.
    pub ours: bool,
    /// Arrival time, modulo 65.5 s [ms].
    pub stamp_ms: u16,
}

/// Length of the header before each packet: length and tag [bytes].
const HEAD: usize = 10;

/// Ring buffer. Positions are byte counts since the start, and wrap.
#[derive(Clone, Debug)]
pub(crate) struct Ring<const N: usize> {
    bytes: [u8; N],
    tail: u32,
    head: u32,
}

impl<const N: usize> Ring<N> {
    /// Returns an empty ring. `N` must be a power of two, so that positions can wrap.
    pub(crate) const fn new() -> Self {
        assert!(N.is_power_of_two() && N >= 2 * (MAX_PACKET + HEAD));
        Self { bytes: [0; N], tail: 0, head: 0 }
    }

    /// Returns the position of the oldest packet.
    pub(crate) fn tail(&self) -> u32 {
        self.tail
    }

    /// Returns the position of the next packet to be written.
    pub(crate) fn head(&self) -> u32 {
        self.head
    }

    /// Whether the ring is empty.
    #[cfg(test)]
    pub(crate) fn is_empty(&self) -> bool {
        self.head == self.tail
    }

    /// Whether a packet of `len` bytes fits without dropping another.
    pub(crate) fn fits(&self, len: usize) -> bool {
        HEAD + len <= N - self.used()
    }

    /// Adds a packet. It must fit, see [`Self::fits`].
    pub(crate) fn push(&mut self, tag: Tag, packet: &[u8]) {
        assert!(self.fits(packet.len()), "the caller makes room");
        let [len0, len1] = (packet.len() as u16).to_le_bytes();
        let [kind0, kind1] = tag.kind.to_le_bytes();
        let [ms0, ms1] = tag.stamp_ms.to_le_bytes();
        let (system, component) = tag.source;
        let head = [len0, len1, kind0, kind1, system, component, tag.to, tag.ours.into(), ms0, ms1];
        self.write(&head);
        self.write(packet);
    }

    /// Returns tag and length of the packet at `place`, and the position behind it.
    pub(crate) fn peek(&self, place: u32) -> Option<(Tag, usize, u32)> {
        if place == self.head {
            return None;
        }
        let mut head = [0; HEAD];
        self.read(place, &mut head);
        let len = usize::from(u16::from_le_bytes([head[0], head[1]]));
        let tag = Tag {
            kind: u16::from_le_bytes([head[2], head[3]]),
            source: (head[4], head[5]),
            to: head[6],
            ours: head[7] != 0,
            stamp_ms: u16::from_le_bytes([head[8], head[9]]),
        };
        Some((tag, len, place.wrapping_add((HEAD + len) as u32)))
    }

    /// Copies the packet at `place` to the start of `out`, which must be long enough.
    pub(crate) fn copy(&self, place: u32, out: &mut [u8]) {
        self.read(place.wrapping_add(HEAD as u32), out);
    }

    /// Removes the oldest packet.
    pub(crate) fn pop(&mut self) {
        if let Some((_, _, next)) = self.peek(self.tail) {
            self.tail = next;
        }
    }

    fn used(&self) -> usize {
        self.head.wrapping_sub(self.tail) as usize
    }

    fn write(&mut self, from: &[u8]) {
        let at = self.head as usize % N;
        let first = from.len().min(N - at);
        self.bytes[at..at + first].copy_from_slice(&from[..first]);
        self.bytes[..from.len() - first].copy_from_slice(&from[first..]);
        self.head = self.head.wrapping_add(from.len() as u32);
    }

    fn read(&self, place: u32, out: &mut [u8]) {
        let at = place as usize % N;
        let first = out.len().min(N - at);
        let rest = out.len() - first;
        out[..first].copy_from_slice(&self.bytes[at..at + first]);
        out[first..].copy_from_slice(&self.bytes[..rest]);
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use std::collections::VecDeque;
    use std::vec;
    use std::vec::Vec;

    use proptest::prelude::*;

    use super::*;

    fn tag(number: u16) -> Tag {
        let byte = number as u8;
        Tag {
            kind: number,
            source: (byte, 1),
            to: byte,
            ours: number.is_multiple_of(3),
            stamp_ms: number ^ 0xFFFF,
        }
    }

    proptest! {
        /// Compares the ring with a deque, over many rounds and across the wrap of the positions.
        #[test]
        fn behaves_like_a_queue(lengths in prop::collection::vec((1..280usize, any::<bool>()), 1..300), start in any::<u32>()) {
            let mut ring = Ring::<1024>::new();
            ring.head = start;
            ring.tail = start;
            let mut model: VecDeque<(Tag, Vec<u8>)> = VecDeque::new();
            for (number, (len, take)) in lengths.into_iter().enumerate() {
                let packet = vec![number as u8; len];
                while !ring.fits(len) {
                    ring.pop();
                    model.pop_front();
                }
                ring.push(tag(number as u16), &packet);
                model.push_back((tag(number as u16), packet));
                if take {
                    let (tag, len, _) = ring.peek(ring.tail()).unwrap();
                    let mut out = vec![0; len];
                    ring.copy(ring.tail(), &mut out);
                    ring.pop();
                    prop_assert_eq!((tag, out), model.pop_front().unwrap());
                }
                prop_assert_eq!(ring.is_empty(), model.is_empty());
                let mut place = ring.tail();
                for (tag, packet) in &model {
                    let (found, len, next) = ring.peek(place).unwrap();
                    prop_assert_eq!((found, len), (*tag, packet.len()));
                    place = next;
                }
                prop_assert_eq!(place, ring.head());
            }
        }
    }
}
