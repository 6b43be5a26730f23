//! Stable radix sort of (key, value) pairs, 8 bits at a time: pass 3, and again in pass 4.
//!
//! Least significant digit first, three dispatches per digit. Ranks are computed in workgroup memory only: correct
//! for any subgroup size and without subgroups, and without waiting for other workgroups.
//!
//! Budget: 20 bytes moved per pair and digit, half a byte of counts; about 10 us per million pairs and digit at 1
//! TB/s.

use super::super::device::{Device, Groups, Kernel};

const SOURCE: &str = concat!(
    include_str!("../common.wgsl"),
    include_str!("../scan.wgsl"),
    include_str!("sizes.wgsl"),
    include_str!("sort.wgsl")
);

/// Keys per workgroup; `SORT_GROUP` in `sizes.wgsl`.
pub(super) const SORT_GROUP: u64 = 2048;
const DIGIT_BITS: u32 = 8;

/// Compiled kernels.
#[derive(Debug)]
pub(super) struct Sort {
    first: Kernels,
    later: Kernels,
}

/// Kernels of one digit.
#[derive(Debug)]
struct Kernels {
    count: Kernel,
    rows: Kernel,
    scatter: Kernel,
}

/// Buffers of a sort. The input is `pairs[0]`; each digit moves it to the other buffer. With `makes_values`, the
/// first digit uses the indices of the keys as values, and drops EMPTY keys.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pairs<'a> {
    pub(super) keys: [&'a wgpu::Buffer; 2],
    pub(super) values: [&'a wgpu::Buffer; 2],
    pub(super) counts: &'a wgpu::Buffer,
    pub(super) sizes: &'a wgpu::Buffer,
}

/// Location of the number of keys, and of the number of workgroups for them.
#[derive(Clone, Copy, Debug)]
pub(super) struct Count {
    /// Index into `sizes`.
    pub(super) size: u32,
    /// Index of the first of three words in `dispatches`.
    pub(super) groups: u32,
}

/// Bindings of one digit.
#[derive(Debug)]
pub(super) struct Digit {
    is_first: bool,
    groups: u32,
    count: wgpu::BindGroup,
    rows: wgpu::BindGroup,
    scatter: wgpu::BindGroup,
}

impl Sort {
    pub(super) fn new(device: &Device) -> Self {
        let kernels = |first: f64| Kernels {
            count: device.kernel(SOURCE, "count", &[("FIRST", first)]),
            rows: device.kernel(SOURCE, "rows", &[]),
            scatter: device.kernel(SOURCE, "scatter", &[("FIRST", first)]),
        };
        Self { first: kernels(1.0), later: kernels(0.0) }
    }

    /// Binds the digits of a sort by keys of up to `bits` bits. The result is in `keys[digits % 2]`,
    /// `values[digits % 2]`. `counts` refers to the keys before and after the first digit; they differ if it drops
    /// some.
    pub(super) fn bind(
        &self,
        device: &Device,
        pairs: Pairs<'_>,
        bits: u32,
        counts: [Count; 2],
        makes_values: bool,
    ) -> Vec<Digit> {
        let bind = |digit: u32| {
            let is_first = digit == 0 && makes_values;
            let kernels = if is_first { &self.first } else { &self.later };
            let Count { size, groups } = counts[usize::from(digit > 0)];
            let words = [digit * DIGIT_BITS, size, 0, 0];
            let place = device.uniform("digit", zerocopy::IntoBytes::as_bytes(&words));
            let (from, to) = (digit as usize % 2, (digit as usize + 1) % 2);
            let (place, sizes, counts) = ((0, &place), (1, pairs.sizes), (6, pairs.counts));
            let scatter = [
                place,
                sizes,
                (2, pairs.keys[from]),
                (3, pairs.values[from]),
                (4, pairs.keys[to]),
                (5, pairs.values[to]),
                counts,
            ];
            Digit {
                is_first,
                groups,
                count: device.bind(&kernels.count, &[place, sizes, (2, pairs.keys[from]), counts]),
                rows: device.bind(&kernels.rows, &[place, sizes, counts]),
                scatter: device.bind(&kernels.scatter, &scatter),
            }
        };
        (0..digits(bits)).map(bind).collect()
    }

    /// Sorts by one digit.
    pub(super) fn run(
        &self,
        pass: &mut wgpu::ComputePass<'_>,
        digit: &Digit,
        dispatches: &wgpu::Buffer,
    ) {
        let kernels = if digit.is_first { &self.first } else { &self.later };
        let groups = Groups::Counted(dispatches, digit.groups);
        kernels.count.run(pass, &digit.count, groups);
        kernels.rows.run(pass, &digit.rows, Groups::Known(1 << DIGIT_BITS, 1));
        kernels.scatter.run(pass, &digit.scatter, groups);
    }
}

/// Returns the number of digits of keys of `bits` bits; at least one.
pub(super) fn digits(bits: u32) -> u32 {
    bits.div_ceil(DIGIT_BITS).max(1)
}

/// Returns the size of the counts for sorting `keys` keys. [byte]
pub(super) fn count_bytes(keys: u64) -> u64 {
    ((keys.div_ceil(SORT_GROUP) + 1) * 4) << DIGIT_BITS
}

#[cfg(test)]
mod tests;
