//! RVL (Wilson, Fast Lossless Depth Image Compression, ISS 2017), implemented from the paper. Runs of zeros and of
//! values alternate. Differences to the last valid value are zig-zagged and stored in groups of three bits and a
//! continuation bit, eight groups per word.

#[derive(Default)]
struct Nibbles {
    words: Vec<u32>,
    word: u32,
    filled: u32,
}

impl Nibbles {
    fn push(&mut self, mut value: u32) {
        loop {
            let more = value > 7;
            self.word = self.word << 4 | value & 7 | u32::from(more) << 3;
            value >>= 3;
            self.filled += 1;
            if self.filled == 8 {
                self.words.push(self.word);
                (self.word, self.filled) = (0, 0);
            }
            if !more {
                return;
            }
        }
    }
}

pub(crate) fn encode(depth: &[u16]) -> Vec<u32> {
    let mut out = Nibbles { words: Vec::with_capacity(depth.len() / 2), ..Nibbles::default() };
    let (mut at, mut last) = (0, 0i32);
    while at < depth.len() {
        let zeros = depth[at..].iter().take_while(|&&pixel| pixel == 0).count();
        out.push(zeros as u32);
        at += zeros;
        let values = depth[at..].iter().take_while(|&&pixel| pixel != 0).count();
        out.push(values as u32);
        for &pixel in &depth[at..at + values] {
            let delta = i32::from(pixel) - last;
            out.push((delta << 1 ^ delta >> 31) as u32);
            last = i32::from(pixel);
        }
        at += values;
    }
    if out.filled > 0 {
        out.words.push(out.word << (4 * (8 - out.filled)));
    }
    out.words
}

pub(crate) fn decode(words: &[u32], depth: &mut [u16]) {
    let (mut at, mut word, mut left) = (0, 0u32, 0);
    let mut pop = || {
        let (mut value, mut shift) = (0, 0);
        loop {
            if left == 0 {
                (word, left) = (words[at], 8);
                at += 1;
            }
            let nibble = word >> 28;
            word <<= 4;
            left -= 1;
            value |= (nibble & 7) << shift;
            shift += 3;
            if nibble & 8 == 0 {
                return value;
            }
        }
    };
    let (mut pixel, mut last) = (0, 0i32);
    while pixel < depth.len() {
        let zeros = pop() as usize;
        depth[pixel..pixel + zeros].fill(0);
        pixel += zeros;
        let values = pop() as usize;
        for out in &mut depth[pixel..pixel + values] {
            let code = pop();
            last += (code >> 1) as i32 ^ -((code & 1) as i32);
            *out = last as u16;
        }
        pixel += values;
    }
}
