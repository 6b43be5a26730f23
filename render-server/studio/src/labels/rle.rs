//! Masks in COCO's format: run lengths along columns, as counts and as COCO's compressed text.
//!
//! Source: Lin et al. 2014, "Microsoft COCO"; the text matches `rleToString` in `maskApi.c` of its tools. A mask is the
//! set of pixels with one id in an image of ids.

use std::collections::BTreeMap;

/// Pixels of an id.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Mask {
    /// Run lengths along the columns, from the left. The first run is outside of the mask and can be 0.
    pub counts: Vec<u32>,
    /// Number of pixels in the mask.
    pub area_px: u32,
    /// Tight box: left, top, width, height. [px]
    pub box_px: [u32; 4],
}

/// Returns the mask of each id except 0, from row-major ids.
pub fn masks(ids: &[u16], [width, height]: [usize; 2]) -> BTreeMap<u16, Mask> {
    debug_assert_eq!(ids.len(), width * height);
    let mut runs: BTreeMap<u16, Runs> = BTreeMap::new();
    for x in 0..width {
        let mut y = 0;
        while y < height {
            let id = ids[y * width + x];
            let start = y;
            while y < height && ids[y * width + x] == id {
                y += 1;
            }
            if id != 0 {
                runs.entry(id).or_default().add([x, start, y], height);
            }
        }
    }
    let pixels = (width * height) as u32;
    runs.into_iter().map(|(id, runs)| (id, runs.finish(pixels))).collect()
}

#[derive(Default)]
struct Runs {
    counts: Vec<u32>,
    /// End of the last run, in column-major order.
    end: u32,
    area_px: u32,
    rows: Option<[u32; 2]>,
    columns: [u32; 2],
}

impl Runs {
    fn add(&mut self, [x, from, to]: [usize; 3], height: usize) {
        let (start, length) = ((x * height + from) as u32, (to - from) as u32);
        match self.counts.last_mut() {
            // The run continues from the bottom of one column to the top of the next.
            Some(last) if self.end == start => *last += length,
            _ => self.counts.extend([start - self.end, length]),
        }
        self.end = start + length;
        self.area_px += length;
        let (from, to, x) = (from as u32, to as u32, x as u32);
        match &mut self.rows {
            None => (self.rows, self.columns) = (Some([from, to]), [x, x + 1]),
            Some([top, bottom]) => {
                (*top, *bottom) = ((*top).min(from), (*bottom).max(to));
                self.columns[1] = x + 1;
            }
        }
    }

    fn finish(mut self, pixels: u32) -> Mask {
        if self.end < pixels {
            self.counts.push(pixels - self.end);
        }
        let ([top, bottom], [left, right]) = (self.rows.unwrap_or_default(), self.columns);
        let box_px = [left, top, right - left, bottom - top];
        Mask { counts: self.counts, area_px: self.area_px, box_px }
    }
}

/// Returns counts as COCO's text: differences to the count before the last, five bits per character.
pub fn to_text(counts: &[u32]) -> String {
    let mut text = String::new();
    for (n, &count) in counts.iter().enumerate() {
        let before = if n > 2 { counts[n - 2] } else { 0 };
        let mut left = i64::from(count) - i64::from(before);
        loop {
            let bits = (left & 0x1f) as u8;
            left >>= 5;
            let ends = left == if bits & 0x10 == 0 { 0 } else { -1 };
            text.push(char::from(48 + bits + if ends { 0 } else { 0x20 }));
            if ends {
                break;
            }
        }
    }
    text
}

/// Returns the counts of COCO's text; `None` if it is invalid.
pub fn from_text(text: &str) -> Option<Vec<u32>> {
    let mut counts: Vec<u32> = Vec::new();
    let mut bytes = text.bytes();
    while bytes.len() > 0 {
        let (mut value, mut shift) = (0i64, 0);
        loop {
            let bits = bytes.next()?.checked_sub(48).filter(|bits| *bits < 64)?;
            value |= i64::from(bits & 0x1f) << shift;
            shift += 5;
            if bits & 0x20 == 0 {
                if bits & 0x10 != 0 {
                    value -= 1 << shift;
                }
                break;
            }
            if shift > 35 {
                return None;
            }
        }
        let n = counts.len();
        let before = if n > 2 { counts[n - 2] } else { 0 };
        counts.push(u32::try_from(value + i64::from(before)).ok()?);
    }
    Some(counts)
}

/// Returns the mask of counts as row-major pixels; `None` if they do not fill the image.
pub fn to_pixels(counts: &[u32], [width, height]: [usize; 2]) -> Option<Vec<bool>> {
    let mut pixels = vec![false; width * height];
    let mut at = 0usize;
    for (n, &count) in counts.iter().enumerate() {
        let end = at.checked_add(count as usize).filter(|end| *end <= pixels.len())?;
        if n % 2 == 1 {
            for k in at..end {
                pixels[k % height * width + k / height] = true;
            }
        }
        at = end;
    }
    (at == pixels.len()).then_some(pixels)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn writes_the_same_text_as_cocos_tools() {
        // pycocotools.mask.encode of a 4 x 3 mask with the pixels (1, 1), (1, 2), (2, 1).
        #[rustfmt::skip]
        let ids = [0, 0, 0, 0,
                   0, 7, 7, 0,
                   0, 7, 0, 0];
        let masks = masks(&ids, [4, 3]);
        let mask = &masks[&7];
        assert_eq!((mask.area_px, mask.box_px), (3, [1, 1, 2, 2]));
        assert_eq!(mask.counts, [4, 2, 1, 1, 4]);
        assert_eq!(to_text(&mask.counts), "421O3");
    }

    proptest! {
        #[test]
        fn masks_survive_a_round_trip(
            size in (1usize..20, 1usize..20),
            seed in prop::collection::vec(0u16..4, 400),
        ) {
            let size = [size.0, size.1];
            let ids = &seed[..size[0] * size[1]];
            let masks = masks(ids, size);
            for id in 1..4u16 {
                let set: Vec<bool> = ids.iter().map(|&other| other == id).collect();
                let Some(mask) = masks.get(&id) else {
                    prop_assert!(!set.contains(&true));
                    continue;
                };
                let counts = from_text(&to_text(&mask.counts)).unwrap();
                prop_assert_eq!(&counts, &mask.counts);
                prop_assert_eq!(to_pixels(&counts, size).unwrap(), set.clone());
                prop_assert_eq!(mask.area_px as usize, set.iter().filter(|set| **set).count());
                let [left, top, wide, high] = mask.box_px.map(|side| side as usize);
                let inside = |k: usize| {
                    let (x, y) = (k % size[0], k / size[0]);
                    (left..left + wide).contains(&x) && (top..top + high).contains(&y)
                };
                prop_assert!((0..set.len()).all(|k| !set[k] || inside(k)));
            }
        }

        #[test]
        fn counts_survive_a_round_trip(counts in prop::collection::vec(0u32..1 << 27, 0..9)) {
            prop_assert_eq!(from_text(&to_text(&counts)).unwrap(), counts);
        }

        #[test]
        fn never_panics_on_any_text(text in "\\PC{0,40}") {
            if let Some(counts) = from_text(&text) {
                let _ = to_pixels(&counts, [7, 5]);
            }
        }
    }
}
